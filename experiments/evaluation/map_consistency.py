"""Errors and consistency of a whole map.

A landmark is gross if its distance to its true point exceeds `GROSS_M` after the rigid fit of the
other landmarks. Gross landmarks are counted, and left out of all other figures. Errors are infinite
and consistency is unknown if too many are left out. The fit is a motion of the plane. An error that
such a motion explains is no error of the relative map. Therefore errors and covariances are
projected by I - J (J'J)^-1 J', where the columns of J (3 n, 3) are the rigid motions: the gauge is
removed. With a basis N of the remaining space,

    N (N' S N)^-1 N' = S^-1 - S^-1 J (J' S^-1 J)^-1 J' S^-1,

so the NEES of the relative map (Bar-Shalom, Li, Kirubarajan 2001, ch. 5.4) needs only S^-1. The
NEES is chi-square distributed if the joint covariance S is right. Its degrees of freedom are the
rank of N. S is block diagonal plus low rank and is inverted by the Woodbury identity, without dense
matrices of its size.
"""

from dataclasses import dataclass, field

import numpy as np
import scipy

from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry import se2
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float, chi_square_bound, squared_mahalanobis
from mapfusion.landmark_map import LandmarkMap

# Several times the error of a map of a room after a fit, and about half the distance between
# neighbouring landmarks.
GROSS_M = 0.15
# Largest share of landmarks that a figure may leave out: the others no longer describe the map.
MOST_GROSS = 0.1
COVERED = 0.95  # nominal probability of the ellipses of `coverage_95`
_LEAST = 3  # landmarks: a rigid fit of two is always exact
_MOST_FITS = 50  # the set of gross landmarks is stable after a few fits


@dataclass(frozen=True)
class FittedMap:
    """Landmarks with a known true point, and their errors after a rigid fit.

    Attributes:
        rows: rows of the map, shape (n,).
        truth_m: true points, moved by the fit into the frame of the map, shape (n, 3).
        error_m: positions in the map minus `truth_m`, shape (n, 3). The height of planar maps is 0.
        frame_error_m: positions in the map minus the true points without a fit, shape (n, 3).
        gross: True for gross landmarks, shape (n,).
    """

    rows: np.ndarray
    truth_m: Float
    error_m: Float
    frame_error_m: Float
    gross: np.ndarray

    @property
    def gross_share(self) -> float:
        """Share of gross landmarks; NaN without landmarks."""
        return float(np.mean(self.gross)) if len(self.rows) else np.nan

    @property
    def too_many_gross(self) -> bool:
        """True if the landmarks that are not gross do not describe the map."""
        return self.gross_share > MOST_GROSS

    @property
    def rmse_m(self) -> float:
        """RMSE after the fit of the landmarks that are not gross.

        NaN without landmarks, infinite if too many are gross.
        """
        return np.inf if self.too_many_gross else rmse(self.error_m[~self.gross])

    @property
    def frame_rmse_m(self) -> float:
        """The same without a fit."""
        return np.inf if self.too_many_gross else rmse(self.frame_error_m[~self.gross])

    @property
    def median_m(self) -> float:
        """Median error in place of the RMSE after the fit."""
        lengths = np.linalg.norm(self.error_m[~self.gross], axis=1)
        if self.too_many_gross:
            return np.inf
        return float(np.median(lengths)) if len(lengths) else np.nan


@dataclass(frozen=True)
class Consistency:
    """Agreement of a map's errors with its covariance.

    NaN for fewer than 3 landmarks, and if too many landmarks are gross.

    Attributes:
        nees_per_dof: NEES of all landmarks together over its degrees of freedom; near 1 if the
            joint covariance is right.
        marginal_nees_per_dof: mean NEES of single landmarks over its degrees of freedom.
        coverage_95: share of landmarks whose 95 % ellipse contains the true point.
        own_nees: NEES of each landmark, shape (n,).
    """

    nees_per_dof: float
    marginal_nees_per_dof: float
    coverage_95: float
    own_nees: Float = field(default_factory=lambda: np.zeros(0), compare=False, repr=False)


UNKNOWN = Consistency(np.nan, np.nan, np.nan)


def rmse(error_m: Float) -> float:
    """Return the root mean square length of errors (n, D); NaN for n = 0."""
    return float(np.sqrt(np.mean(np.sum(error_m**2, axis=1)))) if len(error_m) else np.nan


def fit_to_truth(landmarks: LandmarkMap, point_m: Float) -> FittedMap:
    """Fit the true points rigidly to a map, without gross landmarks.

    The motion and the set of gross landmarks are computed alternately. A few errors of metres can
    shift the first fit so much that all landmarks look gross. Therefore the limit starts at half of
    the largest error and is halved until it reaches `GROSS_M`.

    Args:
        landmarks: map of N landmarks.
        point_m: true points, shape (N, 3); NaN where unknown.
    """
    rows = np.flatnonzero(np.isfinite(point_m).all(axis=1))
    position, truth = landmarks.position_m[rows], point_m[rows]
    gross, moved, limit_m = np.zeros(len(rows), dtype=bool), truth, np.inf
    for _ in range(_MOST_FITS):
        used = np.flatnonzero(~gross)
        if len(used) < _LEAST:
            break
        T_map_truth = np.array(fit_rigid(position, truth, used))
        moved = se2.transform_points(T_map_truth, truth)
        length_m = np.linalg.norm(_error(landmarks, position, moved), axis=1)
        limit_m = max(GROSS_M, min(limit_m, float(length_m.max())) / 2)
        before, gross = gross, length_m > limit_m
        if limit_m == GROSS_M and np.array_equal(before, gross):
            break
    error, frame_error = (_error(landmarks, position, points) for points in (moved, truth))
    return FittedMap(rows, moved, error, frame_error, gross)


def _error(landmarks: LandmarkMap, position_m: Float, truth_m: Float) -> Float:
    error = position_m - truth_m
    if landmarks.planar:
        error[:, 2] = 0.0
    return error


def relative_consistency(landmarks: LandmarkMap, fit: FittedMap) -> Consistency:
    """Return the consistency of the relative map: gauge removed, without gross landmarks."""
    return consistencies(landmarks, fit)[0]


def consistencies(landmarks: LandmarkMap, fit: FittedMap) -> tuple[Consistency, Consistency]:
    """Return the consistency of the relative map, and of the map in the frame of its truth.

    Both leave out gross landmarks. The solution of the linear system is shared.
    """
    not_gross = ~fit.gross
    rows = fit.rows[not_gross]
    if len(rows) < _LEAST or fit.too_many_gross:
        return UNKNOWN, UNKNOWN
    d = landmarks.n_dimensions
    # without a joint covariance, errors of landmarks are taken to be independent
    known = landmarks.joint
    if known is None:
        known = JointCovariance(landmarks.covariance_m2, np.zeros((len(landmarks), 0, 3)))
    own, common = known.own_m2[rows, :d, :d], known.common_m[rows, :, :d]
    common_flat = common.transpose(1, 0, 2).reshape(known.rank, d * len(rows))
    joint = _LowRankCovariance(own, common_flat)
    error, frame_error = fit.error_m[not_gross, :d], fit.frame_error_m[not_gross, :d]
    J = rigid_motions(fit.truth_m[not_gross], d)
    columns = [error[..., None], J, frame_error[..., None]]
    solved = joint.solve(np.concatenate(columns, axis=2)).reshape(error.size, -1)
    n_gauge, no_gauge = J.shape[2], J[..., :0]
    return (
        _consistency(joint, error, J, solved[:, : 1 + n_gauge]),
        _consistency(joint, frame_error, no_gauge, solved[:, 1 + n_gauge :]),
    )


def _consistency(joint: "_LowRankCovariance", error: Float, J: Float, solved: Float) -> Consistency:
    """Return the consistency of errors without their components along J.

    Args:
        joint: joint covariance S of the errors.
        error: errors, shape (n, D).
        J: directions to remove, shape (n, D, k); k may be 0.
        solved: S^-1 applied to the errors and J, shape (n D, 1 + k).
    """
    n, d = error.shape
    J_flat = J.reshape(error.size, -1)
    # the NEES by the identity above
    pull, stiffness = J_flat.T @ solved[:, 0], J_flat.T @ solved[:, 1:]
    nees = error.ravel() @ solved[:, 0] - pull @ np.linalg.solve(stiffness, pull)
    # errors and marginal covariances, projected by I - Q Q' with an orthonormal basis Q of J
    projected, marginal = error, joint.marginals
    if J_flat.shape[1]:
        Q = np.linalg.qr(J_flat)[0]
        SQ = joint.times(Q)
        projected = (error.ravel() - Q @ (Q.T @ error.ravel())).reshape(n, d)
        Q_of, SQ_of = Q.reshape(n, d, -1), SQ.reshape(n, d, -1)
        mixed = SQ_of @ np.swapaxes(Q_of, 1, 2)
        both = Q_of @ (Q.T @ SQ) @ np.swapaxes(Q_of, 1, 2)
        marginal = marginal - mixed - np.swapaxes(mixed, 1, 2) + both
    own = squared_mahalanobis(projected, marginal)
    inside = np.mean(own <= chi_square_bound(COVERED, d))
    dof = error.size - J_flat.shape[1]
    return Consistency(float(nees / dof), float(np.mean(own) / d), float(inside), own)


def rigid_motions(point_m: Float, n_dimensions: int) -> Float:
    """Return the derivatives J (n, D, 3) of points by x, y and rotation about their mean.

    Args:
        point_m: points, shape (n, 3).
        n_dimensions: D, 2 or 3.
    """
    J = np.zeros((len(point_m), n_dimensions, 3))
    x, y = (point_m - point_m.mean(axis=0))[:, :2].T
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -y, x
    return J


@dataclass(frozen=True)
class _LowRankCovariance:
    """Joint covariance S of n landmarks in D dimensions: block diagonal plus low rank.

    Attributes:
        own: diagonal blocks, shape (n, D, D).
        common: C, shape (R, n D), where C' C is the low-rank part.
    """

    own: Float
    common: Float

    @property
    def _by_landmark(self) -> Float:
        """C' by landmark, shape (n, D, R)."""
        return self.common.T.reshape(*self.own.shape[:2], len(self.common))

    def times(self, flat: Float) -> Float:
        """Return S x for x (n D, k)."""
        n, d, _ = self.own.shape
        by_landmark = (self.own @ flat.reshape(n, d, -1)).reshape(n * d, -1)
        return by_landmark + self.common.T @ (self.common @ flat)

    def solve(self, x: Float) -> Float:
        """Return S^-1 x for x (n, D, k) by the Woodbury identity."""
        n, d, k = x.shape
        C = self._by_landmark
        by_own = np.linalg.solve(self.own, np.concatenate([x, C], axis=2)).reshape(n * d, -1)
        own_x, own_C = by_own[:, :k], by_own[:, k:]
        inner = np.eye(len(self.common)) + self.common @ own_C
        factor = scipy.linalg.cho_factor(inner, check_finite=False)
        return (own_x - own_C @ scipy.linalg.cho_solve(factor, self.common @ own_x)).reshape(
            n, d, k
        )

    @property
    def marginals(self) -> Float:
        """Marginal covariances of the landmarks, shape (n, D, D)."""
        C = self._by_landmark
        return self.own + C @ np.swapaxes(C, 1, 2)
