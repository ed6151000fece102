"""What the SLAM stage wrote, read again: the robot's map at each evaluated iteration."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from experiments.run.stages.slam import ASSOCIATIONS, PATHS, SNAPSHOTS
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog, with_rows
from mapfusion.se2 import Float
from mapfusion.storage import POSE_FIELDS, column, columns, points_from, read_table
from mapfusion.viewing import Sightings


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
    """

    def __init__(self, slam: Path, log: RobotLog) -> None:
        self._slam, self._log = slam, log
        table, attributes = read_table(slam / "snapshots.parquet", SNAPSHOTS)
        origin = column(table, "source_observation")
        seen = log.observations[origin]
        about = (column(table, "count"), origin, seen.descriptor, seen.label, log.planar, log.robot)
        self._landmarks = LandmarkMap(*points_from(table), *about, calibration=log.calibration)
        self._rows = _rows(column(table, "iteration"), attributes["iterations"])
        self._made: dict[int, LandmarkMap] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[int]:
        return iter(self._rows)

    def __getitem__(self, iteration: int) -> LandmarkMap:
        if iteration not in self._made:
            landmarks = with_rows(self._landmarks, self._rows[iteration])
            log, path = self._log, self._path(iteration)
            n_seen = int(np.searchsorted(log.iteration, iteration + 1))
            counts_for = self._associations.at(iteration, n_seen)
            source = landmarks.source_observation
            viewing = self._sightings.viewing(counts_for, path, source)
            self._made[iteration] = replace(landmarks, viewing=viewing)
        return self._made[iteration]

    @cached_property
    def _sightings(self) -> Sightings:
        return Sightings.of(self._log)

    @cached_property
    def _associations(self) -> Associations:
        return Associations.read(self._slam)

    @cached_property
    def _paths(self) -> tuple[np.ndarray, Float]:
        table, _ = read_table(self._slam / "paths.parquet", PATHS)
        return column(table, "evaluated"), columns(table, POSE_FIELDS)

    def _path(self, iteration: int) -> Float:
        """The path (iteration + 1, 3) that the map was made along."""
        evaluated, poses = self._paths
        return poses[slice(*np.searchsorted(evaluated, [iteration, iteration + 1]))]


def _rows(iteration: np.ndarray, evaluated: str) -> dict[int, slice]:
    known = map(int, evaluated.split(","))
    return {k: slice(*np.searchsorted(iteration, [k, k + 1])) for k in known}
