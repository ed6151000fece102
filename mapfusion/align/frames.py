"""Frames of two maps: origins near the landmarks, offset and tilt of the heights.

Sums of squares of coordinates lose the digits that the distance from the origin takes. Maps far
from the origin of their frame, as in UTM, are therefore aligned and fused in local frames, and
motions and covariances are moved back at the end. With origins o_a and o_b the motion of the given
frames is

    t = o_a + t_local - R o_b,    theta = theta_local.

The motion is planar, and heights are compared beside it. They may differ by a constant, a fourth
degree of freedom. If one map is tilted, the difference is a plane over the position.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import rotation, transform_points
from mapfusion.landmark_map import LandmarkMap

# Largest relative rounding error of sums of squares about the origin, eps (D / s)^2 for landmarks
# of RMS extent s at the distance D. The refinement ends at movements of 1e-8 m, and maps measure up
# to some kilometres.
_ROUNDING = 1e-12
_FAR = math.sqrt(_ROUNDING / np.finfo(np.float64).eps)  # D / s
_LEAST_EXTENT_M = 1.0  # smaller maps do not determine an angle, wherever they lie
# Probability that equal heights are taken for an offset, or level maps for tilted ones.
_HEIGHT_FALSE_ALARM = 1e-3
_DOF, _ROUNDS = 4.0, 20  # Student-t weights of heights, and number of reweighted least squares
_MEDIAN_OVER_SIGMA = 0.6745  # median absolute value of a standard normal variable


def origin_of(landmarks: LandmarkMap) -> Float:
    """Return the origin (2,) of a map's local frame; zero if the map is near its own origin.

    The origin is the centroid in whole metres, so that the subtraction is exact.
    """
    p_planar = landmarks.position_m[:, :2]
    if not len(p_planar):
        return np.zeros(2)
    middle = p_planar.mean(axis=0)
    extent_m = math.sqrt(np.mean(np.sum((p_planar - middle) ** 2, axis=1)))
    is_far = np.hypot(*middle) > _FAR * max(extent_m, _LEAST_EXTENT_M)
    return np.round(middle) if is_far else np.zeros(2)


def in_local_frame(landmarks: LandmarkMap, origin_m: Float, height_m: float = 0.0) -> LandmarkMap:
    """Return a map with another origin (2,), lowered by `height_m`.

    Errors of the calibration turn and scale the local map about its new origin. The old origin is
    that of a survey, not of a camera.
    """
    if not origin_m.any() and height_m == 0:
        return landmarks
    viewing = landmarks.viewing
    if viewing is not None:
        pose = viewing.pose.copy()
        pose[:, :2] -= origin_m
        viewing = replace(viewing, pose=pose)
    position = landmarks.position_m - np.append(origin_m, height_m)
    return replace(landmarks, position_m=position, viewing=viewing)


def moved_motion(
    T_a_b: Float, covariance: Float, origin_a: Float, origin_b: Float
) -> tuple[Float, Float]:
    """Return a motion (3,) and its covariance (3, 3) in frames whose local origins are given.

    The opposite origins move a motion back.
    """
    turned = rotation(T_a_b[2]) @ origin_b
    moved = np.array([*(origin_a + T_a_b[:2] - turned), T_a_b[2]])
    by_local = np.eye(3)
    by_local[:2, 2] = turned[1], -turned[0]  # d(-R o_b) / d theta
    return moved, by_local @ covariance @ by_local.T


class Overlap(NamedTuple):
    """Motion about the middle of the pairs that support it.

    The covariance of a motion at a far origin is mostly the effect of the angle.

    Attributes:
        p_a: the middle in frame a, shape (2,).
        p_b: the middle in frame b, shape (2,), which the motion moves to `p_a`.
        theta_rad: angle of the motion.
        covariance: covariance of the moved point and of the angle, shape (3, 3).
    """

    p_a: Float
    p_b: Float
    theta_rad: float
    covariance: Float

    @classmethod
    def of(cls, T_a_b: Float, covariance: Float, p_b: Float) -> "Overlap":
        """Return the motion about the mean of points (n, 2 or more) of map b, n at least 1."""
        middle = p_b[:, :2].mean(axis=0)
        p_a = transform_points(T_a_b, middle)
        _, at_middle = moved_motion(T_a_b, covariance, -p_a, -middle)
        return cls(p_a, middle, float(T_a_b[2]), at_middle)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the moved point, the root of the sum of both variances."""
        return math.sqrt(self.covariance[0, 0] + self.covariance[1, 1])

    def document(self) -> dict[str, float]:
        """Return all numbers by name, for files."""
        content = {"a_x_m": self.p_a[0], "a_y_m": self.p_a[1]}
        content |= {"b_x_m": self.p_b[0], "b_y_m": self.p_b[1]}
        axes = ("xx_m2", "xy_m2", "xt_m_rad", "yy_m2", "yt_m_rad", "tt_rad2")
        upper = self.covariance[np.triu_indices(3)]
        return content | {f"cov_{name}": x for name, x in zip(axes, upper, strict=True)}

    def moved(self, by_a: Float, by_b: Float) -> "Overlap":
        """Return the same motion in frames in which all points are larger by (2,)."""
        return self._replace(p_a=self.p_a + by_a, p_b=self.p_b + by_b)

    def motion(self, origin_a: Float, origin_b: Float) -> tuple[Float, Float]:
        """Return T_a_b and its covariance in local frames with these origins."""
        turn = np.array([0.0, 0.0, self.theta_rad])
        return moved_motion(turn, self.covariance, self.p_a - origin_a, self.p_b - origin_b)


def height_offset_m(up_m: Float, variance_m2: Float, bound: float) -> float:
    """Return the constant by which map b is higher, 0 if pairs of equal height are as many.

    The offset is the middle of the gate that most pairs pass. It replaces 0 if pairs that pass
    there only outnumber those that pass at 0 only (sign test, for all gates side by side).

    Args:
        up_m: heights of map b minus those of map a, of N pairs at any height.
        variance_m2: variances of these differences, shape (N,).
        bound: largest squared difference over its variance.
    """
    if not len(up_m):
        return 0.0
    reach = np.sqrt(bound * variance_m2)
    width_m = 2 * float(np.median(reach))
    ranked = np.sort(up_m)
    inside = np.searchsorted(ranked, ranked + width_m, side="right") - np.arange(len(ranked))
    first = int(np.argmax(inside))
    offset_m = float(np.median(ranked[first : first + inside[first]]))
    fits_zero, fits_offset = np.abs(up_m) <= reach, np.abs(up_m - offset_m) <= reach
    wins = np.count_nonzero(fits_offset & ~fits_zero)
    losses = np.count_nonzero(fits_zero & ~fits_offset)
    n_gates = 1 + (ranked[-1] - ranked[0]) / width_m
    # P(X >= own) for equally likely sides
    by_chance = scipy.special.bdtrc(wins - 1, wins + losses, 0.5) if wins else 1.0
    return offset_m if by_chance * n_gates <= _HEIGHT_FALSE_ALARM else 0.0


@dataclass(frozen=True)
class HeightDifference:
    """Heights of map b minus heights of map a, at the pairs that agree in plan.

    Attributes:
        offset_m: the difference at the middle of the supporting pairs.
        sigma_m: its standard deviation.
        tilt_rad: angle between the maps' height axes, from the slope of the difference.
        tilt_sigma_rad: its standard deviation.
        n_level: pairs whose heights agree up to the offset.
        n_tilted: pairs whose heights agree up to offset and tilt.
        is_tilted: True if the tilt is significant and explains more pairs than the offset.
    """

    offset_m: float
    sigma_m: float
    tilt_rad: float = math.nan
    tilt_sigma_rad: float = math.nan
    n_level: int = 0
    n_tilted: int = 0
    is_tilted: bool = False

    @property
    def used_offset_m(self) -> float:
        """Return the offset if it differs from 0 significantly, else 0."""
        bound = chi_square_bound(1 - _HEIGHT_FALSE_ALARM, 1)
        return self.offset_m if self.offset_m**2 > bound * self.sigma_m**2 else 0.0

    @property
    def loses_pairs(self) -> bool:
        """True if most pairs fail the test of heights because of the tilt."""
        return self.is_tilted and self.n_tilted > 2 * self.n_level

    def document(self) -> dict[str, float | bool]:
        """Return the numbers by name, for files."""
        return {
            "offset_m": self.offset_m,
            "sigma_m": self.sigma_m,
            "used_offset_m": self.used_offset_m,
            "tilt_deg": math.degrees(self.tilt_rad),
            "tilt_sigma_deg": math.degrees(self.tilt_sigma_rad),
            "is_tilted": self.is_tilted,
        }

    def offset_note(self, name_a: str, name_b: str) -> str:
        """Return the offset in words; empty if it is not significant."""
        if not self.used_offset_m:
            return ""
        side = "higher" if self.offset_m > 0 else "lower"
        return (
            f"{name_b} is {abs(self.offset_m):.3f} m {side} than {name_a} "
            f"(sigma {self.sigma_m:.3f} m)"
        )

    def tilt_note(self, name_a: str, name_b: str) -> str:
        """Return the tilt in words; empty if the maps are level."""
        if not self.is_tilted:
            return ""
        return (
            f"{name_b} is tilted by {math.degrees(self.tilt_rad):.1f} degrees against {name_a} "
            f"(heights of {self.n_level} of {self.n_tilted} pairs agree without the tilt): "
            "level one of the maps, or leave out the heights"
        )


class _PlaneFit(NamedTuple):
    """Robust least squares of heights: coefficients (k,), their covariance (k, k)."""

    value: Float
    covariance: Float


def _fit_heights(by: Float, up_m: Float, variance_m2: Float) -> _PlaneFit:
    """Fit `up_m` (n,) by a linear model (n, k) with Student-t weights (Lange et al. 1989).

    The scatter of the residuals replaces the stated variances if it is larger. Weights start from
    the fit of least absolute residuals, because half of the pairs may be false.
    """
    weight, scale2 = np.ones(len(up_m)), 1.0
    value, normal = np.zeros(by.shape[1]), np.eye(by.shape[1])
    for k in range(_ROUNDS):
        weighted = by.T * (weight / variance_m2)
        normal = weighted @ by
        value = np.asarray(np.linalg.solve(normal, weighted @ up_m), np.float64)
        normalised_residual = np.abs(up_m - by @ value) / np.sqrt(variance_m2)
        scale2 = max(1.0, (float(np.median(normalised_residual)) / _MEDIAN_OVER_SIGMA) ** 2)
        if k < _ROUNDS // 2:
            weight = 1 / np.maximum(normalised_residual, math.sqrt(scale2) / 10)
        else:
            weight = (_DOF + 1) / (_DOF + normalised_residual**2 / scale2)
    return _PlaneFit(value, scale2 * np.asarray(np.linalg.inv(normal), np.float64))


def height_difference(
    p_a: Float,
    p_b: Float,
    variance_m2: Float,
    bound: float,
    supports: np.ndarray,
    removed_m: float = 0.0,
) -> HeightDifference | None:
    """Compare the heights of pairs that agree in plan; None without two supporters.

    The tilt is significant if the slope differs from 0 (chi-square, 2 degrees of freedom) and pairs
    that only the tilt explains outnumber those that only the offset explains (sign test).

    Args:
        p_a: positions in map a, shape (n, 3).
        p_b: positions in map b, shape (n, 3).
        variance_m2: variances of the height differences, shape (n,).
        bound: largest squared difference of heights over its variance.
        supports: pairs that support the motion, bool, shape (n,).
        removed_m: offset that was subtracted from map b before.
    """
    if np.count_nonzero(supports) < 2:
        return None
    up_m = p_b[:, 2] - p_a[:, 2]
    middle = p_a[supports, :2].mean(axis=0)
    constant = np.ones((len(up_m), 1))
    level = _fit_heights(constant[supports], up_m[supports], variance_m2[supports])
    offset_m, sigma_m = float(level.value[0]), math.sqrt(level.covariance[0, 0])
    # pairs from at least two places in each direction, with a pair to spare
    p_planar = p_a[:, :2] - middle
    if len(up_m) < 4 or np.linalg.matrix_rank(p_planar - p_planar.mean(axis=0)) < 2:
        return HeightDifference(removed_m + offset_m, sigma_m)
    plane = _fit_heights(np.hstack([constant, p_planar]), up_m, variance_m2)
    slope, S = plane.value[1:], plane.covariance[1:, 1:]
    steepness = float(np.hypot(*slope))
    along = slope / steepness if steepness > 0 else np.array([1.0, 0.0])
    tilt_sigma_rad = math.sqrt(along @ S @ along) / (1 + steepness**2)
    reach = np.sqrt(bound * variance_m2)
    by_offset = np.abs(up_m - offset_m) <= reach
    by_plane = np.abs(up_m - plane.value[0] - p_planar @ slope) <= reach
    wins = np.count_nonzero(by_plane & ~by_offset)
    losses = np.count_nonzero(by_offset & ~by_plane)
    by_chance = scipy.special.bdtrc(wins - 1, wins + losses, 0.5) if wins else 1.0
    square = float(slope @ np.linalg.solve(S, slope))
    steep = square > chi_square_bound(1 - _HEIGHT_FALSE_ALARM, 2)
    is_tilted = bool(steep and by_chance <= _HEIGHT_FALSE_ALARM)
    if is_tilted:
        offset_m, sigma_m = float(plane.value[0]), math.sqrt(plane.covariance[0, 0])
    counts = int(np.count_nonzero(by_offset)), int(np.count_nonzero(by_plane))
    tilt_rad = math.atan(steepness)
    return HeightDifference(
        removed_m + offset_m, sigma_m, tilt_rad, tilt_sigma_rad, *counts, is_tilted
    )


def level_heights(n_maps: int, robots: np.ndarray, offset_m: Float, sigma_m: Float) -> Float:
    """Return the height (n_maps,) of each map by weighted least squares of offsets of pairs.

    Offsets are those of the second map of `robots` (E, 2) above the first. The mean height of
    connected maps is 0.
    """
    by = np.zeros((len(robots), n_maps))
    each = np.arange(len(robots))
    by[each, robots[:, 0]], by[each, robots[:, 1]] = -1.0, 1.0
    solved = np.linalg.lstsq(by / sigma_m[:, None], offset_m / sigma_m, rcond=None)[0]
    return np.asarray(solved, np.float64)
