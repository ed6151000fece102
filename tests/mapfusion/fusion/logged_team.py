"""Robots with white-noise logs of one world, and the maps that a smoother makes of them."""

from dataclasses import replace
from itertools import combinations

import numpy as np

from mapfusion.align.alignment import Alignment, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fusers import AlignedPair, Component, FusedMap
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog
from mapfusion.smoother.smooth import AssociatedLog, SmootherParameters, smooth, smoothed_map
from tests.mapfusion.smoother.white_noise_logs import (
    Known,
    dead_reckoned,
    scattered,
    white_noise_log,
    with_tracks,
)

STRAY_M = 0.05
START_SIGMA = np.array([0.03, 0.03, 0.01])  # m, m, rad, of what a component says of its maps


class LoggedTeam:
    """Robots drive in circles that meet, and number landmarks by what they saw first.

    Attributes:
        T_world_robot: (K, 3) where each began.
        world_m: (L, 3) landmarks, which labels number.
        known: of each robot, its log with the truth in its own frame.
        recordings: of each, with its smoothed path.
        maps: of each, smoothed.
    """

    def __init__(
        self,
        seed: int,
        n_robots: int = 2,
        n_frames: int = 60,
        n_landmarks: int = 40,
        planar: bool = False,
        tracks: bool = False,
    ) -> None:
        self._rng = rng = np.random.default_rng(seed)
        self.T_world_robot = rng.uniform([-0.5, -0.5, -0.6], [1, 1, 0.6], (n_robots, 3))
        self.world_m = scattered(rng, n_landmarks, planar)
        self.known = [self._known(T, n_frames, planar, tracks) for T in self.T_world_robot]
        self.recordings = [_recorded(each) for each in self.known]
        found = [smooth(r.log, r.landmark, r.path, r.parameters) for r in self.recordings]
        self.recordings = [
            replace(own, path=each.estimate.path, landmark=each.landmark)
            for own, each in zip(self.recordings, found, strict=True)
        ]
        self.maps = [
            smoothed_map(own.log, each) for own, each in zip(self.recordings, found, strict=True)
        ]

    def _known(self, T_world_robot: Float, n_frames: int, planar: bool, tracks: bool) -> Known:
        point = se2.transform_points(se2.inverse(T_world_robot), self.world_m)
        known = white_noise_log(self._rng, n_frames, len(point), planar, point)
        return with_tracks(known, self._rng, STRAY_M) if tracks else known

    def component(self, *members: int) -> Component:
        """Some of the maps, the first of them the frame, placed with small errors."""
        first, n = members[0], len(self.maps)
        T, covariance = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
        for k in members:
            off = self._rng.normal(0, START_SIGMA) * (k != first)
            T[k] = self.motion(first, k) + off
            covariance[k] = np.diag(START_SIGMA**2) * (k != first)
        pairs = tuple(self._pair(a, b) for a, b in combinations(members, 2))
        recordings = tuple(self.recordings)
        return Component(tuple(self.maps), np.array(members), pairs, T, covariance, (), recordings)

    def motion(self, first: int, k: int) -> Float:
        """(3,) the truth."""
        return se2.between(self.T_world_robot[first], self.T_world_robot[k])

    def _pair(self, a: int, b: int) -> AlignedPair:
        """All landmarks that both have; what else it says is only of use for finding components."""
        label_a, label_b = labels(self.maps[a]), labels(self.maps[b])
        _, at_a, at_b = np.intersect1d(label_a, label_b, return_indices=True)
        alignment = Alignment(
            self.motion(a, b),
            np.diag(START_SIGMA**2),
            np.ones(len(at_a), dtype=bool),
            0.0,
            Status.ACCEPTED,
            "",
            0.0,
        )
        return AlignedPair(a, b, alignment, Correspondences(at_a, at_b, np.zeros(len(at_a))))

    def errors(self, fused: FusedMap) -> Float:
        """(N, 3) of the fused landmarks, in the first member's frame."""
        T_robot_world = se2.inverse(self.T_world_robot[fused.members[0]])
        truth = se2.transform_points(T_robot_world, self.world_m)
        return fused.landmarks.position_m - truth[labels(fused.landmarks)]

    def motion_error(self, fused: FusedMap, k: int) -> Float:
        """(3,) of the motion of one map into the fused frame."""
        off = fused.T_first_map[k] - self.motion(int(fused.members[0]), k)
        off[2] = se2.wrap(off[2])
        return off


def labels(landmarks: LandmarkMap) -> np.ndarray:
    """Return the labels of the world's landmarks."""
    assert landmarks.label is not None
    return landmarks.label


def log_labels(log: RobotLog) -> np.ndarray:
    """The same of each observation."""
    assert log.observations.label is not None
    return log.observations.label


def _recorded(known: Known) -> AssociatedLog:
    """With dead reckoning for a path."""
    log = known.log
    _, first, inverse = np.unique(log_labels(log), return_index=True, return_inverse=True)
    has_tracks = log.observations.track is not None
    parameters = SmootherParameters(stray_m=STRAY_M if has_tracks else 0.0)
    return AssociatedLog(log, first[inverse], dead_reckoned(log), parameters)
