"""Errors that belong to a track: a corner that is followed strays over its wall, and not at random.

All views of a landmark share what its corner strays from one and the same point: a Gaussian process
along the track, isotropic in metres, whose correlation decays with the frames between two views
(Ornstein and Uhlenbeck). Beside it every view has its own error, as the log states it. So residuals
e_i, in the map frame, of one landmark have the covariance

    C_ik = delta_ik R_i / w_i + stray_m^2 exp(-|t_i - t_k| / decay) I

and their information is no longer block diagonal. What of the stray is the same in all views moves
the landmark and nothing else; what changes is what a smoother of white errors takes for motion.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import njit

from mapfusion.arguments import Range, require_in_range
from mapfusion.se2 import Float
from mapfusion.smoother.normal_equations import Estimate, NormalEquations
from mapfusion.smoother.sightings import Sightings


@dataclass(frozen=True)
class Stray:
    """How corners stray.

    Attributes:
        sigma_m: standard deviation along each axis; 0 for landmarks that do not stray.
        decay_frames: frames after which a correlation is 1 / e.
    """

    sigma_m: Annotated[float, Range(0, 1, "m")] = 0.0
    decay_frames: Annotated[float, Range(0.1, 1e6, "frames")] = 25.0

    def __post_init__(self) -> None:
        require_in_range(self)


@dataclass(frozen=True)
class TrackInformation:
    """Information (3, 3) between any two views of a landmark, in the map frame.

    Attributes:
        first: (L + 1,) where each landmark's blocks begin; its view i and k have block
            first + i n + k, with n its number of views.
        block: (sum of n^2, 3, 3).
    """

    first: np.ndarray
    block: Float


def track_information(
    seen: Sightings, heading_rad: Float, stray: Stray, weight: Float, track_weight: Float
) -> TrackInformation:
    """The inverse of C for each landmark.

    Args:
        seen: the observations.
        heading_rad: (T,) of the robot.
        stray: how corners stray.
        weight: (N,) factor on the information of each view's own error.
        track_weight: (L,) factor on the information of all views of a landmark.
    """
    count = np.diff(seen.starts)
    first = np.concatenate([[0], np.cumsum(count**2)])
    block = np.zeros((first[-1], 3, 3))
    _invert(
        seen.arrays, seen.n_dimensions, heading_rad, stray.sigma_m**2, stray.decay_frames,
        weight, track_weight, first, block,
    )  # fmt: skip
    return TrackInformation(first, block)


@njit(cache=True)
def _invert(
    seen: tuple[np.ndarray, np.ndarray, Float, Float],
    dimensions: int,
    heading_rad: Float,
    variance_m2: float,
    decay_frames: float,
    weight: Float,
    track_weight: Float,
    first: np.ndarray,
    block: Float,
) -> None:
    starts, frame, _, information = seen
    for j in range(len(starts) - 1):
        begin, n = starts[j], starts[j + 1] - starts[j]
        C = np.empty((dimensions * n, dimensions * n))
        for i in range(n):
            for k in range(n):
                apart = abs(frame[begin + i] - frame[begin + k])
                shared = variance_m2 * np.exp(-apart / decay_frames)
                for r in range(dimensions):
                    for q in range(dimensions):
                        C[dimensions * i + r, dimensions * k + q] = shared if r == q else 0.0
            own = _own_covariance(information[begin + i], heading_rad[frame[begin + i]], dimensions)
            at = dimensions * i
            C[at : at + dimensions, at : at + dimensions] += own / weight[begin + i]
        W = np.linalg.inv(C)
        for i in range(n):
            for k in range(n):
                to = block[first[j] + i * n + k]
                for r in range(dimensions):
                    for q in range(dimensions):
                        to[r, q] = track_weight[j] * W[dimensions * i + r, dimensions * k + q]


@njit(cache=True)
def _own_covariance(information: Float, heading_rad: float | Float, dimensions: int) -> Float:
    """Of a view's own error, in the map frame."""
    R = np.eye(3)[:dimensions, :dimensions].copy()
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    R[0, 0], R[0, 1], R[1, 0], R[1, 1] = c, -s, s, c
    return R @ np.linalg.inv(information[:dimensions, :dimensions].copy()) @ R.T


def add_tracks(
    seen: Sightings, at: Estimate, tracks: TrackInformation, made: NormalEquations, between: Float
) -> None:
    """Add the observations to the equations; terms of two poses go to `between` (3T, 3T).

    Of that the lower half is filled in.
    """
    _add(seen.arrays, at, tracks.first, tracks.block, made, between)


@njit(cache=True)
def _add(
    seen: tuple[np.ndarray, np.ndarray, Float, Float],
    at: Estimate,
    first: np.ndarray,
    block: Float,
    made: NormalEquations,
    between: Float,
) -> None:
    starts, frame, position, _ = seen
    for j in range(len(starts) - 1):
        begin, n = starts[j], starts[j + 1] - starts[j]
        e, lever = _residuals(frame[begin : begin + n], position[begin : begin + n], at, j)
        for i in range(n):
            W = np.zeros((3, 3))
            gradient = np.zeros(3)
            row = 3 * frame[begin + i]
            for k in range(n):
                shared = block[first[j] + i * n + k]
                W += shared
                gradient += shared @ e[k]
                if k <= i:
                    column = 3 * frame[begin + k]
                    _add_product(lever[i], shared, lever[k], between[row:, column:])
            made.point_block[j] += W
            made.point_gradient[j] += gradient
            for q in range(3):
                made.coupling[begin + i, 0, q] = -W[0, q]
                made.coupling[begin + i, 1, q] = -W[1, q]
                made.coupling[begin + i, 2, q] = lever[i, 0] * W[0, q] + lever[i, 1] * W[1, q]
            made.pose_gradient[frame[begin + i], 0] -= gradient[0]
            made.pose_gradient[frame[begin + i], 1] -= gradient[1]
            turning = lever[i, 0] * gradient[0] + lever[i, 1] * gradient[1]
            made.pose_gradient[frame[begin + i], 2] += turning


@njit(cache=True)
def _residuals(frame: np.ndarray, position: Float, at: Estimate, j: int) -> tuple[Float, Float]:
    """Residuals (n, 3) of a landmark's views in the map frame, and de/dtheta (n, 2)."""
    e, lever = np.empty((len(frame), 3)), np.empty((len(frame), 2))
    point = at.point_m[j]
    for i in range(len(frame)):
        x, y, theta = at.path[frame[i]]
        c, s = np.cos(theta), np.sin(theta)
        lever[i, 0], lever[i, 1] = point[1] - y, x - point[0]
        e[i, 0] = point[0] - x - c * position[i, 0] + s * position[i, 1]
        e[i, 1] = point[1] - y - s * position[i, 0] - c * position[i, 1]
        e[i, 2] = point[2] - position[i, 2]
    return e, lever


@njit(cache=True)
def _add_product(lever: Float, W: Float, other: Float, to: Float) -> None:
    """Add J' W K for J = [-I, lever] and K = [-I, other] of x and y."""
    for r in range(2):
        for q in range(2):
            to[r, q] += W[r, q]
        to[r, 2] -= W[r, 0] * other[0] + W[r, 1] * other[1]
        to[2, r] -= lever[0] * W[0, r] + lever[1] * W[1, r]
    for r in range(2):
        to[2, 2] += lever[r] * (W[r, 0] * other[0] + W[r, 1] * other[1])


def track_distances(
    seen: Sightings, at: Estimate, tracks: TrackInformation, weight: Float
) -> tuple[Float, Float]:
    """Squared Mahalanobis distances (L,) of whole tracks, and (N,) of views from the others.

    A view's is that from where all other views of the landmark say that it should be. The
    covariance of that is the inverse of the view's own block of information; here with the view's
    own error as it is without its weight (N,).
    """
    of_track, of_view = np.zeros(len(seen.starts) - 1), np.zeros(len(seen))
    _distances(
        seen.arrays, seen.n_dimensions, at, tracks.first, tracks.block, weight, of_track, of_view
    )
    return of_track, of_view


@njit(cache=True)
def _distances(
    seen: tuple[np.ndarray, np.ndarray, Float, Float],
    dimensions: int,
    at: Estimate,
    first: np.ndarray,
    block: Float,
    weight: Float,
    of_track: Float,
    of_view: Float,
) -> None:
    starts, frame, position, information = seen
    for j in range(len(starts) - 1):
        begin, n = starts[j], starts[j + 1] - starts[j]
        e, _ = _residuals(frame[begin : begin + n], position[begin : begin + n], at, j)
        for i in range(n):
            pull = np.zeros(3)
            for k in range(n):
                pull += block[first[j] + i * n + k] @ e[k]
            of_track[j] += pull @ e[i]
            row = begin + i
            left_out = np.linalg.inv(block[first[j] + i * n + i, :dimensions, :dimensions].copy())
            error = left_out @ pull[:dimensions]
            heading_rad = at.path[frame[row], 2]
            own = _own_covariance(information[row], heading_rad, dimensions)
            left_out += (1 - 1 / weight[row]) * own
            of_view[row] = error @ np.linalg.solve(left_out, error)
