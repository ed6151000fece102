"""What the SLAM stage wrote, read again: the robot's map at each evaluated iteration."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from experiments.pipeline.stages.slam import ASSOCIATIONS, PATHS, SNAPSHOTS, RobotFolders
from mapfusion.files import POSE_FIELDS, column, columns, points_from, read_table
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog, read_log, with_rows
from mapfusion.viewing import LogSightings, Viewing

ROBOTS_KEPT = 4  # by a process; of a robot that drives for minutes they are tens of megabytes


class Associations:
    """Which landmark each observation is of, as it changed between evaluated iterations.

    Attributes:
        from_iteration: (C,) of each change, growing.
        observation: (C,) row of the log.
        source: (C,) the observation that its landmark came from, -1 for none.
    """

    def __init__(
        self, from_iteration: np.ndarray, observation: np.ndarray, source: np.ndarray
    ) -> None:
        order = np.argsort(from_iteration, kind="stable")
        self.from_iteration = from_iteration[order]
        self.observation, self.source = observation[order], source[order]

    @classmethod
    def read(cls, slam: Path) -> "Associations":
        """From the stage's folder."""
        table, _ = read_table(slam / "associations.parquet", ASSOCIATIONS)
        names = ("from_iteration", "observation", "source_observation")
        return cls(*(column(table, name) for name in names))

    def at(self, iteration: int, n_observations: int) -> np.ndarray:
        """(n_observations,) int64 source of each of the log's first observations then."""
        counts_for = np.full(n_observations, -1, dtype=np.int64)
        so_far = slice(np.searchsorted(self.from_iteration, iteration, side="right"))
        # the last change of an observation is the one that stays
        counts_for[self.observation[so_far]] = self.source[so_far]
        return counts_for


class Snapshots(Mapping[int, LandmarkMap]):
    """The robot's map at each evaluated iteration, with what its log tells of the landmarks.

    These are descriptors, labels, and from where they were seen. A map is made when it is first
    asked for: most that read them want a few of them.

    Args:
        slam: the stage's folder.
        log: what was filtered.
        viewing: whether maps come with their viewing evidence, which is of the whole log so far.
    """

    def __init__(self, slam: Path, log: RobotLog, viewing: bool = True) -> None:
        self._slam, self._log, self._viewing = slam, log, viewing
        table, attributes = read_table(slam / "snapshots.parquet", SNAPSHOTS)
        about = (column(table, "count"), column(table, "source_observation"))
        self._landmarks = LandmarkMap(*points_from(table), *about)
        self._rows = _rows(column(table, "iteration"), attributes["iterations"])
        self._made: dict[int, LandmarkMap] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[int]:
        return iter(self._rows)

    def __getitem__(self, iteration: int) -> LandmarkMap:
        if iteration not in self._made:
            landmarks, log = with_rows(self._landmarks, self._rows[iteration]), self._log
            origin, seen = landmarks.source_observation, log.observations
            self._made[iteration] = replace(
                landmarks,
                descriptor=None if seen.descriptor is None else seen.descriptor[origin],
                label=None if seen.label is None else seen.label[origin],
                planar=log.planar,
                name=log.robot,
                viewing=self._viewing_of(iteration, origin) if self._viewing else None,
                calibration=log.calibration,
            )
        return self._made[iteration]

    def _viewing_of(self, iteration: int, origin: np.ndarray) -> Viewing:
        log, path = self._log, self._path(iteration)
        n_seen = int(np.searchsorted(log.iteration, iteration + 1))
        return self._sight_lines.viewing(self.associations.at(iteration, n_seen), path, origin)

    @cached_property
    def _sight_lines(self) -> LogSightings:
        return LogSightings.of(self._log)

    @cached_property
    def associations(self) -> Associations:
        """Which landmark each of the log's observations is of."""
        return Associations.read(self._slam)

    @cached_property
    def _paths(self) -> tuple[np.ndarray, Float]:
        table, _ = read_table(self._slam / "paths.parquet", PATHS)
        return column(table, "evaluated"), columns(table, POSE_FIELDS)

    def _path(self, iteration: int) -> Float:
        """The path (iteration + 1, 3) that the map was made along."""
        evaluated, poses = self._paths
        return poses[slice(*np.searchsorted(evaluated, [iteration, iteration + 1]))]


def stored_maps(folders: RobotFolders, viewing: bool = True) -> Snapshots:
    """A robot's maps, with or without viewing evidence.

    Those of a few robots stay in memory with all that was made of them, since stage after stage
    wants the same. Their folder is named after what the log holds: of another log it is another.
    """
    return _stored_maps(folders, viewing)


@functools.lru_cache(maxsize=ROBOTS_KEPT)
def _stored_maps(folders: RobotFolders, viewing: bool) -> Snapshots:
    return Snapshots(folders.slam, read_log(folders.log), viewing)


def _rows(iteration: np.ndarray, evaluated: str) -> dict[int, slice]:
    known = map(int, evaluated.split(","))
    return {k: slice(*np.searchsorted(iteration, [k, k + 1])) for k in known}
