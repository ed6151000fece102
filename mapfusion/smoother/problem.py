"""Least-squares problem of the smoother: observations ordered by landmark and by track."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mapfusion.geometry.numerics import Float, inverses, require_shape
from mapfusion.robot_log import NO_TRACK, RobotLog
from mapfusion.smoother.cholesky import Envelope, envelope_order, first_entries


@dataclass(frozen=True)
class PoseOrder:
    """Elimination order of T poses.

    Attributes:
        landmark: landmark of each observation, shape (N,).
        frame: frame of each observation, shape (N,).
        n_poses: T.
    """

    landmark: np.ndarray
    frame: np.ndarray
    n_poses: int

    @cached_property
    def place(self) -> np.ndarray:
        """Place of each pose in the order, shape (T,); the known first pose is first."""
        place, later = np.zeros(self.n_poses, dtype=np.int64), self.frame > 0
        unknown = self.frame[later] - 1
        place[1:] = 1 + envelope_order(self.landmark[later], unknown, self.n_poses - 1)
        return place

    @cached_property
    def envelope(self) -> Envelope:
        """Envelope of the unknown poses' matrix, with three rows per pose."""
        later = self.frame > 0
        chosen = (self.landmark[later], self.frame[later] - 1, self.place[1:] - 1)
        return Envelope(np.repeat(3 * first_entries(*chosen), 3))

    def is_sparser_than(self, n_points: int) -> bool:
        """Return True if a factor of the poses takes fewer products than one of `n_points` points.

        The factor of the poses takes half the sum of squared row lengths. The factor of the points
        takes a product with all poses and a dense Cholesky factor.
        """
        n_rows, n = 3 * self.n_poses, 3 * n_points
        of_points = n_rows * n**2 + n**3 / 6
        return self._least_products < of_points and self._products < of_points

    @cached_property
    def _products(self) -> float:
        """Number of multiplications of the poses' Cholesky factor."""
        lengths = np.arange(len(self.envelope)) - self.envelope.first
        return float(np.sum(lengths.astype(np.float64) ** 2) / 2)

    @cached_property
    def _least_products(self) -> float:
        """Lower bound of `_products` for any order.

        All poses of a landmark are related. If the bound is too large no order has to be computed.
        """
        pairs = np.unique(self.landmark * np.int64(self.n_poses) + self.frame)
        most_poses = np.bincount(pairs // self.n_poses).max(initial=0)
        return (3.0 * most_poses) ** 3 / 6


@dataclass(frozen=True)
class OrderedObservations:
    """N observations of L landmarks from T poses, ordered by landmark, track and frame.

    All observations of a track are of one point, which has an offset from the landmark. A track
    that is part of several landmarks counts as one track of each. Observations of a landmark
    without a track count as one track without an offset.

    Attributes:
        starts: row of each landmark's first observation, shape (L + 1,).
        track_starts: row of each track's first observation, shape (B + 1,).
        has_offset: true for tracks with an offset, shape (B,).
        frame: frame of each observation, shape (N,).
        position_m: observed positions in the robot frame, shape (N, 3).
        information: inverses of the stated covariances, in 1/m^2, shape (N, 3, 3); zero in z if
            planar.
        row: row in the log, shape (N,).
        n_dimensions: 3, or 2 if planar.
        order: elimination order of the poses; it does not depend on the information.
    """

    starts: np.ndarray
    track_starts: np.ndarray
    has_offset: np.ndarray
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
        """Number of landmarks L."""
        return len(self.starts) - 1

    @property
    def pose_index(self) -> np.ndarray:
        """Place of each pose in the elimination order, shape (T,); the first pose is first."""
        return self.order.place

    @cached_property
    def unknown_index(self) -> np.ndarray:
        """Place of each observation's pose among the unknown ones, shape (N,); -1 for the first."""
        return self.pose_index[self.frame] - 1

    @cached_property
    def first_track(self) -> np.ndarray:
        """Track of each landmark's first observation, shape (L + 1,)."""
        return np.searchsorted(self.track_starts, self.starts)

    @property
    def by_landmark(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Arrays for kernels: first row and track of each landmark, first row of each track."""
        return self.starts, self.first_track, self.track_starts

    def with_covariance_scale(self, scale: float) -> "OrderedObservations":
        """Multiply the stated covariances of observations on tracks with offsets by `scale`."""
        if scale == 1:
            return self
        share = np.where(self.has_offset[self.track], 1 / scale, 1.0)
        return replace(self, information=self.information * share[:, None, None])

    @cached_property
    def landmark(self) -> np.ndarray:
        """Landmark of each observation, from 0, shape (N,)."""
        return np.repeat(np.arange(self.n_landmarks), np.diff(self.starts))

    @cached_property
    def track(self) -> np.ndarray:
        """Track of each observation, from 0, shape (N,)."""
        return np.repeat(np.arange(len(self.has_offset)), np.diff(self.track_starts))

    @cached_property
    def landmark_of_track(self) -> np.ndarray:
        """Landmark of each track, shape (B,)."""
        return self.landmark[self.track_starts[:-1]]

    def sum_by_landmark(self, values: Float) -> Float:
        """Sum values (N, ...) over the observations of each landmark, shape (L, ...)."""
        return _sums(values, self.starts)

    def sum_by_track(self, values: Float) -> Float:
        """Sum values (N, ...) over the observations of each track, shape (B, ...)."""
        return _sums(values, self.track_starts)

    def sum_tracks(self, values: Float) -> Float:
        """Sum values (B, ...) over the tracks of each landmark, shape (L, ...)."""
        return _sums(values, self.first_track)


def _sums(values: Float, starts: np.ndarray) -> Float:
    if not len(values):
        return np.zeros((0, *values.shape[1:]))
    return np.add.reduceat(values, starts[:-1])


def order_observations(
    log: RobotLog, landmark: np.ndarray, min_count: int, *, with_offsets: bool
) -> OrderedObservations:
    """Order the observations of landmarks that were observed at least `min_count` times.

    Args:
        log: the log.
        landmark: number of each observation's landmark, any integers, shape (N,); negative for
            none.
        min_count: number of observations that a landmark needs.
        with_offsets: true if tracks have offsets from their landmarks.

    Raises:
        ValueError: the length of `landmark` differs from the log's.
        LinAlgError: the covariance of an observation is not positive definite.
    """
    require_shape("landmark", landmark, (len(log.observations),))
    names, inverse, count = np.unique(landmark, return_inverse=True, return_counts=True)
    used_rows = np.flatnonzero(((names >= 0) & (count >= min_count))[inverse])
    track = log.observations.track
    track = track if with_offsets and track is not None else np.full(len(landmark), NO_TRACK)
    row = used_rows[np.lexsort((track[used_rows], inverse[used_rows]))]
    begins = np.diff(inverse[row], prepend=-1) != 0
    starts = np.append(np.flatnonzero(begins), len(row))
    begins |= np.diff(track[row], prepend=NO_TRACK) != 0
    first = np.flatnonzero(begins)
    has_offset, track_starts = track[row[first]] != NO_TRACK, np.append(first, len(row))
    n = 2 if log.planar else 3
    information = np.zeros((len(row), 3, 3))
    information[:, :n, :n] = inverses(log.observations.covariance_m2[row, :n, :n])
    position = np.ascontiguousarray(log.observations.position_m[row], dtype=np.float64)
    if log.planar:
        position[:, 2] = 0.0
    frame = log.iteration[row].astype(np.int64)
    order = PoseOrder(np.repeat(np.arange(len(starts) - 1), np.diff(starts)), frame, len(log))
    return OrderedObservations(
        starts, track_starts, has_offset, frame, position, information, row, n, order
    )
