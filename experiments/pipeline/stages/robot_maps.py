"""Maps of a robot at each evaluated iteration, from the files of the stages."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from experiments.pipeline.stage import Job
from experiments.pipeline.stages.slam import PATHS, SNAPSHOTS, Associations
from experiments.pipeline.stages.smooth import read_endings, read_smoothed
from mapfusion.files import POSE_FIELDS, column, columns, points_from, read_table
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog, read_log, with_rows
from mapfusion.smoother.smooth import with_path_errors
from mapfusion.viewing import LogSightings

_Known = TypeVar("_Known")


class RobotFolders(NamedTuple):
    """Folders of a robot's log (with its truth), of its SLAM result and of its smoothed maps.

    Maps have a joint covariance of their errors where a smoothed map is known.
    """

    log: Path
    slam: Path
    smooth: Path | None = None


def folders_of_both(job: Job) -> list[RobotFolders]:
    """Return the folders of the two robots of a pair's job."""
    folders, inputs = [], job.inputs
    for side in "ab":
        smooth = inputs.get(f"smooth_{side}")
        folders.append(RobotFolders(inputs[f"log_{side}"], inputs[f"slam_{side}"], smooth))
    return folders


def latest_at(known: Mapping[int, _Known], iteration: int) -> _Known:
    """Return a robot's value at an iteration; the last one if the log ended earlier."""
    return known[max((k for k in known if k <= iteration), default=min(known))]


ROBOTS_KEPT = 4  # robots whose maps a process keeps; tens of megabytes for minutes of driving


class Snapshots(Mapping[int, LandmarkMap]):
    """Map of a robot at each evaluated iteration, created at the first access.

    Descriptors, labels and viewing evidence of the landmarks are taken from the log.

    Args:
        slam: folder of the stage.
        log: the filter's input log.
        viewing: True if maps have viewing evidence, which depends on the whole log up to then.
        smoothed: smoothed maps by iteration. The last one until an iteration determines the joint
            covariance of the errors of the filter's map.
    """

    def __init__(
        self,
        slam: Path,
        log: RobotLog,
        viewing: bool = True,
        smoothed: Mapping[int, LandmarkMap] = MappingProxyType({}),
    ) -> None:
        self._slam, self._log, self._viewing, self._smoothed = slam, log, viewing, smoothed
        table, attributes = read_table(slam / "snapshots.parquet", SNAPSHOTS)
        about = (column(table, "count"), column(table, "source_observation"))
        self._landmarks = LandmarkMap(*points_from(table), *about)
        iteration, evaluated = (
            column(table, "iteration"),
            map(int, attributes["iterations"].split(",")),
        )
        self._rows = {k: slice(*np.searchsorted(iteration, [k, k + 1])) for k in evaluated}
        self._made: dict[int, LandmarkMap] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[int]:
        return iter(self._rows)

    def __getitem__(self, iteration: int) -> LandmarkMap:
        if iteration not in self._made:
            landmarks, log = with_rows(self._landmarks, self._rows[iteration]), self._log
            origin, seen = landmarks.source_observation, log.observations
            viewing = None
            if self._viewing:  # along the path from which the map was computed
                evaluated, poses = self._paths
                path = poses[slice(*np.searchsorted(evaluated, [iteration, iteration + 1]))]
                n_seen = int(np.searchsorted(log.iteration, iteration + 1))
                owner = self.associations.at(iteration, n_seen)
                viewing = self._sight_lines.viewing(owner, path, origin)
            made = replace(
                landmarks,
                descriptor=None if seen.descriptor is None else seen.descriptor[origin],
                label=None if seen.label is None else seen.label[origin],
                planar=log.planar,
                name=log.robot,
                viewing=viewing,
                calibration=log.calibration,
            )
            known = [k for k in self._smoothed if k <= iteration]
            if known:
                last = max(known)
                made = with_path_errors(made, self._smoothed[last], complete=last == iteration)
            self._made[iteration] = made
        return self._made[iteration]

    @cached_property
    def _sight_lines(self) -> LogSightings:
        return LogSightings.of(self._log)

    @cached_property
    def associations(self) -> Associations:
        """Landmark of each of the log's observations."""
        return Associations.read(self._slam)

    @cached_property
    def _paths(self) -> tuple[np.ndarray, Float]:
        table, _ = read_table(self._slam / "paths.parquet", PATHS)
        return column(table, "evaluated"), columns(table, POSE_FIELDS)


@functools.lru_cache(maxsize=ROBOTS_KEPT)
def stored_maps(folders: RobotFolders, *, viewing: bool) -> Snapshots:
    """Return a robot's maps, with or without viewing evidence.

    Maps of a few robots stay in memory, because several stages read them. The name of their folder
    depends on the content of the log.
    """
    smoothed = {} if folders.smooth is None else read_smoothed(folders.smooth)
    return Snapshots(folders.slam, read_log(folders.log), viewing, smoothed)


@functools.lru_cache(maxsize=ROBOTS_KEPT)
def smoothed_maps(folders: RobotFolders, *, viewing: bool) -> Mapping[int, LandmarkMap]:
    """Return a robot's maps at the iterations at which maps are fused: smoothed ones if possible.

    Where smoothing failed, the last smoothed map until then stands in. Before the first one, the
    filter's map does.
    """
    assert folders.smooth is not None
    smoothed, filtered = read_smoothed(folders.smooth), stored_maps(folders, viewing=viewing)
    first = min(smoothed, default=np.inf)
    before = [k for k in read_endings(folders.smooth)["iteration"].tolist() if k < first]
    return {k: latest_at(filtered, k) for k in before} | smoothed


def maps_of(
    folders: RobotFolders, *, smoothed: bool, viewing: bool = True
) -> Mapping[int, LandmarkMap]:
    """Return a robot's smoothed maps or those of the filter."""
    return (smoothed_maps if smoothed else stored_maps)(folders, viewing=viewing)
