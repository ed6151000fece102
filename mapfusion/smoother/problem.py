"""Least-squares problem of the smoother: observations ordered by landmark and by track."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mapfusion.geometry.numerics import Float, inverses
from mapfusion.parameters import require_shape
from mapfusion.robot_log import NO_TRACK, RobotLog
from mapfusion.smoother.cholesky import Envelope, envelope_order, first_entries


@dataclass(frozen=True)
class PoseOrder:
    """In what order the poses of T frames are solved for, by the landmarks that they saw.

    Attributes:
        landmark: (N,) of each observation.
        frame: (N,) that each was made in.
        n_poses: T.
    """

    landmark: np.ndarray
    frame: np.ndarray
    n_poses: int

    @cached_property
    def place(self) -> np.ndarray:
        """(T,) of each pose; the first, which is known, comes first."""
        place, later = np.zeros(self.n_poses, dtype=np.int64), self.frame > 0
        unknown = self.frame[later] - 1
        place[1:] = 1 + envelope_order(self.landmark[later], unknown, self.n_poses - 1)
        return place

    @cached_property
    def envelope(self) -> Envelope:
        """Of what is between the unknown poses, three rows of each by their places."""
        later = self.frame > 0
        chosen = (self.landmark[later], self.frame[later] - 1, self.place[1:] - 1)
        return Envelope(np.repeat(3 * first_entries(*chosen), 3))

    def is_sparser_than(self, n_points: int) -> bool:
        """Return True if a factor of the poses takes fewer products than one of `n_points` points.

        These are multiplications of floating-point numbers: the poses' factor takes half the
        squares of its rows' lengths, the points' a product with all poses and a dense factor.
        """
        n_rows, n = 3 * self.n_poses, 3 * n_points
        of_points = n_rows * n**2 + n**3 / 6
        return self._least_products < of_points and self._products < of_points

    @cached_property
    def _products(self) -> float:
        """Return the number of multiplications of the poses' Cholesky factor."""
        lengths = np.arange(len(self.envelope)) - self.envelope.first
        return float(np.sum(lengths.astype(np.float64) ** 2) / 2)

    @cached_property
    def _least_products(self) -> float:
        """Return a lower bound of `_products` in any order: poses of one landmark are all related.

        Where this is too much already, no order has to be found.
        """
        pairs = np.unique(self.landmark * np.int64(self.n_poses) + self.frame)
        most = np.bincount(pairs // self.n_poses).max(initial=0)
        return (3.0 * most) ** 3 / 6


@dataclass(frozen=True)
class Sightings:
    """N observations of L landmarks from T poses, ordered by landmark, track and frame.

    All observations of a track are of one point, which lies beside the landmark. A track that went
    into several landmarks is one for each of them. What a landmark was observed without a track
    counts as one track, which is of the landmark itself.

    Attributes:
        starts: (L + 1,) row of each landmark's first observation.
        track_starts: (B + 1,) row of each track's first observation.
        strays: (B,) whether the track's point lies beside the landmark.
        frame: (N,) frame that each observation was made in.
        position_m: (N, 3) in the robot frame.
        information: (N, 3, 3) inverse of the stated covariances, in 1/m^2; zero in z if planar.
        row: (N,) row in the log.
        n_dimensions: 3, or 2 if planar.
        order: of the poses; it is the same whatever the information is.
    """

    starts: np.ndarray
    track_starts: np.ndarray
    strays: np.ndarray
    frame: np.ndarray
    position_m: Float
    information: Float
    row: np.ndarray
    n_dimensions: int
    order: PoseOrder

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def n_landmarks(self) -> int:
        """L."""
        return len(self.starts) - 1

    @property
    def pose_place(self) -> np.ndarray:
        """(T,) order in which poses are solved for; the first, which is known, comes first."""
        return self.order.place

    @cached_property
    def unknown_place(self) -> np.ndarray:
        """(N,) of each observation's pose among those that are unknown; -1 for the first pose."""
        return self.pose_place[self.frame] - 1

    @cached_property
    def first_track(self) -> np.ndarray:
        """(L + 1,) track of each landmark's first observation."""
        return np.searchsorted(self.track_starts, self.starts)

    @property
    def by_landmark(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What kernels take: by landmark its first row and its first track, by track its rows."""
        return self.starts, self.first_track, self.track_starts

    def on_level(self, level: float) -> "Sightings":
        """With stated covariances of observations on tracks that stray multiplied by `level`."""
        if level == 1:
            return self
        share = np.where(self.strays[self.track], 1 / level, 1.0)
        return replace(self, information=self.information * share[:, None, None])

    @cached_property
    def landmark(self) -> np.ndarray:
        """(N,) the landmark of each observation: 0, 1, ..."""
        return np.repeat(np.arange(self.n_landmarks), np.diff(self.starts))

    @cached_property
    def track(self) -> np.ndarray:
        """(N,) the track of each observation: 0, 1, ..."""
        return np.repeat(np.arange(len(self.strays)), np.diff(self.track_starts))

    @cached_property
    def landmark_of_track(self) -> np.ndarray:
        """(B,)."""
        return self.landmark[self.track_starts[:-1]]

    def sum_by_landmark(self, values: Float) -> Float:
        """(L, ...) sums of values (N, ...) over the observations of each landmark."""
        return _sums(values, self.starts)

    def sum_by_track(self, values: Float) -> Float:
        """(B, ...) sums of values (N, ...) over the observations of each track."""
        return _sums(values, self.track_starts)

    def sum_tracks(self, values: Float) -> Float:
        """(L, ...) sums of values (B, ...) over the tracks of each landmark."""
        return _sums(values, self.first_track)


def _sums(values: Float, starts: np.ndarray) -> Float:
    if not len(values):
        return np.zeros((0, *values.shape[1:]))
    return np.add.reduceat(values, starts[:-1])


def sightings_of(log: RobotLog, landmark: np.ndarray, min_count: int, *, stray: bool) -> Sightings:
    """The observations of landmarks that were seen at least `min_count` times.

    Args:
        log: what the robot measured.
        landmark: (N,) number of the landmark that each observation of the log is of, any integers;
            negative for none.
        min_count: observations that a landmark needs.
        stray: whether tracks are of points beside their landmarks, else of the landmarks.

    Raises:
        ValueError: `landmark` is not of the log's length.
        LinAlgError: an observation's covariance is not positive definite.
    """
    require_shape("landmark", landmark, (len(log.observations),))
    names, inverse, count = np.unique(landmark, return_inverse=True, return_counts=True)
    taken = np.flatnonzero(((names >= 0) & (count >= min_count))[inverse])
    track = log.observations.track
    track = track if stray and track is not None else np.full(len(landmark), NO_TRACK)
    row = taken[np.lexsort((track[taken], inverse[taken]))]
    another = np.diff(inverse[row], prepend=-1) != 0
    starts = np.append(np.flatnonzero(another), len(row))
    another |= np.diff(track[row], prepend=NO_TRACK) != 0
    first = np.flatnonzero(another)
    strays, track_starts = track[row[first]] != NO_TRACK, np.append(first, len(row))
    n = 2 if log.planar else 3
    information = np.zeros((len(row), 3, 3))
    information[:, :n, :n] = inverses(log.observations.covariance_m2[row, :n, :n])
    position = np.ascontiguousarray(log.observations.position_m[row], dtype=np.float64)
    if log.planar:
        position[:, 2] = 0.0
    frame = log.iteration[row].astype(np.int64)
    order = PoseOrder(np.repeat(np.arange(len(starts) - 1), np.diff(starts)), frame, len(log))
    return Sightings(starts, track_starts, strays, frame, position, information, row, n, order)
