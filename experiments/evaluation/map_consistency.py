"""A map against the truth as a whole: how far off it is, and whether it knows how far.

All that is judged so is judged by these definitions. A landmark is gross if it lies more than
`GROSS_M` from its true point after the best rigid fit of the others; the same ones are left out of
every figure and counted. The fit is a motion of the plane. What it could explain is no error of the
relative map: with J the rigid motions (3 n, 3), errors and covariances are projected by
I - J (J'J)^-1 J' (the gauge is removed). With N a basis of what that leaves,

    N (N' S N)^-1 N' = S^-1 - S^-1 J (J' S^-1 J)^-1 J' S^-1,

so the NEES of the relative map (Bar-Shalom, Li, Kirubarajan 2001, ch. 5.4) needs S^-1 alone. It is
chi-square distributed with the rank of N as degrees of freedom if the joint covariance S is right.
S is block diagonal plus low rank, so its inverse is Woodbury's, and nothing dense of its size is
made.
"""

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from experiments.evaluation.truth import degrees_of_freedom, squared_mahalanobis
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry import se2
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.landmark_map import LandmarkMap

# Several times what a map of a room is off by after a fit (0.01 to 0.05 m); another landmark is,
# where there are as many as cameras see, nearer than twice that only by chance.
GROSS_M = 0.15
COVERED = 0.95  # of the errors, by ellipses that are to be counted on
_LEAST = 3  # landmarks: two fit any two
_MOST_FITS = 50  # the set of gross ones is stable after a few


@dataclass(frozen=True)
class FittedMap:
    """A map's landmarks of known truth, beside it after the best rigid fit.

    Attributes:
        rows: (n,) of the map.
        truth_m: (n, 3) true points, moved by the fit into the frame of the map.
        error_m: (n, 3) the map's points from there; of planar data without height.
        frame_error_m: (n, 3) the map's points from the true ones as they were given, likewise.
        gross: (n,) bool.
    """

    rows: np.ndarray
    truth_m: Float
    error_m: Float
    frame_error_m: Float
    gross: np.ndarray

    @property
    def gross_share(self) -> float:
        """NaN of no landmark."""
        return float(np.mean(self.gross)) if len(self.rows) else np.nan

    @property
    def rmse_m(self) -> float:
        """Of the landmarks that are not gross; NaN of none."""
        return rmse(self.error_m[~self.gross])


@dataclass(frozen=True)
class Consistency:
    """Whether errors are what a map's covariance says; NaN of fewer than 3 landmarks.

    Attributes:
        nees_per_dof: squared Mahalanobis distance of all landmarks at once over its degrees of
            freedom: 1 if the joint covariance is right.
        marginal_nees_per_dof: the mean of the landmarks' own.
        coverage_95: share of the landmarks whose 95 % ellipse holds the true point.
        own_nees: (n,) each landmark's own squared Mahalanobis distance.
    """

    nees_per_dof: float
    marginal_nees_per_dof: float
    coverage_95: float
    own_nees: Float = field(default_factory=lambda: np.zeros(0), compare=False, repr=False)


UNKNOWN = Consistency(np.nan, np.nan, np.nan)


def rmse(error_m: Float) -> float:
    """Root mean square length of errors (n, D); NaN of none."""
    return float(np.sqrt(np.mean(np.sum(error_m**2, axis=1)))) if len(error_m) else np.nan


def fit_to_truth(landmarks: LandmarkMap, point_m: Float) -> FittedMap:
    """The best rigid fit of the true points (N, 3), NaN where unknown, to a map.

    It is the least-squares motion of the landmarks that are not gross, found by turns with these.
    The farthest are left out first, those beyond half of the largest error, a quarter, ...: few
    that are metres off move the first fit so far that all others look gross.
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
    off, frame_off = (_error(landmarks, position, points) for points in (moved, truth))
    return FittedMap(rows, moved, off, frame_off, gross)


def _error(landmarks: LandmarkMap, position_m: Float, truth_m: Float) -> Float:
    error = position_m - truth_m
    if landmarks.planar:
        error[:, 2] = 0.0
    return error


def relative_consistency(landmarks: LandmarkMap, fit: FittedMap) -> Consistency:
    """Of the map as such: gauge removed, gross landmarks left out."""
    return consistencies(landmarks, fit)[0]


def consistencies(landmarks: LandmarkMap, fit: FittedMap) -> tuple[Consistency, Consistency]:
    """The relative one, and that of the map in the frame that its truth was given in.

    Both without the gross landmarks; what takes long is the same for both.
    """
    kept = ~fit.gross
    rows = fit.rows[kept]
    if len(rows) < _LEAST:
        return UNKNOWN, UNKNOWN
    d = degrees_of_freedom(landmarks)
    joint = _joint_of(landmarks, rows, d)
    error, frame_error = fit.error_m[kept, :d], fit.frame_error_m[kept, :d]
    J = rigid_motions(fit.truth_m[kept], d)
    columns = [error[..., None], J, frame_error[..., None]]
    solved = joint.solve(np.concatenate(columns, axis=2)).reshape(error.size, -1)
    n_gauge, no_gauge = J.shape[2], J[..., :0]
    return (
        _consistency(joint, error, J, solved[:, : 1 + n_gauge]),
        _consistency(joint, frame_error, no_gauge, solved[:, 1 + n_gauge :]),
    )


def _consistency(joint: "_LowRankCovariance", error: Float, J: Float, solved: Float) -> Consistency:
    """Of errors (n, D) without what lies along J (n, D, k), by S^-1 of both (n D, 1 + k)."""
    d = error.shape[1]
    J_flat = J.reshape(error.size, -1)
    pull, stiffness = J_flat.T @ solved[:, 0], J_flat.T @ solved[:, 1:]
    nees = error.ravel() @ solved[:, 0] - pull @ np.linalg.solve(stiffness, pull)
    left, marginal = _projected(joint, error, J_flat)
    own = squared_mahalanobis(left, marginal)
    inside = np.mean(own <= chi_square_bound(COVERED, d))
    dof = error.size - J_flat.shape[1]
    return Consistency(float(nees / dof), float(np.mean(own) / d), float(inside), own)


def rigid_motions(point_m: Float, n_dimensions: int) -> Float:
    """J (n, D, 3): how x, y and a rotation of the frame move points (n, 3), about their mean."""
    J = np.zeros((len(point_m), n_dimensions, 3))
    x, y = (point_m - point_m.mean(axis=0))[:, :2].T
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -y, x
    return J


@dataclass(frozen=True)
class _LowRankCovariance:
    """S of n landmarks in D dimensions: block diagonal `own` (n, D, D) plus C' C, C (R, n D)."""

    own: Float
    common: Float

    @property
    def _by_landmark(self) -> Float:
        """(n, D, R)."""
        return self.common.T.reshape(*self.own.shape[:2], len(self.common))

    def times(self, flat: Float) -> Float:
        """S x, for x (n D, k)."""
        n, d, _ = self.own.shape
        by_landmark = (self.own @ flat.reshape(n, d, -1)).reshape(n * d, -1)
        return by_landmark + self.common.T @ (self.common @ flat)

    def solve(self, x: Float) -> Float:
        """S^-1 x, for x (n, D, k), by Woodbury: small blocks, and a matrix (R, R)."""
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
        """(n, D, D)."""
        C = self._by_landmark
        return self.own + C @ np.swapaxes(C, 1, 2)


def _joint_of(landmarks: LandmarkMap, rows: np.ndarray, d: int) -> _LowRankCovariance:
    """The joint covariance of some landmarks; without one, errors are taken for independent."""
    joint = landmarks.joint
    if joint is None:
        joint = JointCovariance(landmarks.covariance_m2, np.zeros((len(landmarks), 0, 3)))
    own, common = joint.own_m2[rows, :d, :d], joint.common_m[rows, :, :d]
    return _LowRankCovariance(own, common.transpose(1, 0, 2).reshape(joint.rank, d * len(rows)))


def _projected(joint: _LowRankCovariance, error: Float, J: Float) -> tuple[Float, Float]:
    """Errors (n, D), and marginal covariances (n, D, D), without what lies along J (n D, k)."""
    n, d = error.shape
    if not J.shape[1]:
        return error, joint.marginals
    Q = np.linalg.qr(J)[0]
    SQ = joint.times(Q)
    left = error.ravel() - Q @ (Q.T @ error.ravel())
    Q_of, SQ_of = Q.reshape(n, d, -1), SQ.reshape(n, d, -1)
    mixed = SQ_of @ np.swapaxes(Q_of, 1, 2)
    both = Q_of @ (Q.T @ SQ) @ np.swapaxes(Q_of, 1, 2)
    return left.reshape(n, d), joint.marginals - mixed - np.swapaxes(mixed, 1, 2) + both
