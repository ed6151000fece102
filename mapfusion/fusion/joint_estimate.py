"""Joint least squares over maps that carry joint covariances.

Of map k the landmarks are x = m + C' z_k + e (`joint_covariance.py`): z_k is standard normal and
shared, e is the landmark's own. Landmarks of several maps that are one point g say

    T_k (m + C' z_k + e) = g,    so that    y_k(u) = T_k (m + C' z_k) is g but for e

and u = (T_1, ..., z_0, z_1, ...) is all that has to be found: some hundred unknowns, whatever the
number of landmarks. Given u each point is the weighted mean of what its maps say, and goes first:

    g = V sum W_k y_k,   V = (sum W_k)^-1,    cost = |z|^2 + sum (y_k - g)' W_k (y_k - g)

with W_k the inverse covariance of T_k e, times the weight of a Student-t: a landmark may be another
point than it is taken for. The first map's frame is the frame, so T_0 is no unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg

from mapfusion.align.rigid_motion import motion_jacobian
from mapfusion.fusion.aligned_landmarks import ABSENT
from mapfusion.geometry.camera import EXACT, N_OF_CAMERA, CalibrationError
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float, inverses
from mapfusion.geometry.se2 import inverse, rotation_about_z, transform_points, wrap
from mapfusion.landmark_map import LandmarkMap
from mapfusion.smoother.robust_loss import MOST_DOF, fit_dof, information_share, student_weights


@dataclass(frozen=True)
class JointMap:
    """N landmarks of a map as they enter.

    Attributes:
        position_m: (N, D); D is 2 for planar maps.
        joint: of the positions, in three dimensions, but for the calibration.
        calibration: what its camera leaves open: two shared variables more, the last ones, unless
            it is known exactly. Maps of one camera have them in common.
    """

    position_m: Float
    joint: JointCovariance
    calibration: CalibrationError = EXACT

    def __len__(self) -> int:
        return len(self.position_m)

    @property
    def n_shared(self) -> int:
        """R."""
        return self.joint.rank + (0 if self.calibration.is_none else N_OF_CAMERA)

    @classmethod
    def of(cls, landmarks: LandmarkMap, own_sigma_m: float, n_dimensions: int) -> "JointMap":
        """A map without a joint covariance shares none, but has more of its landmarks' own.

        Args:
            landmarks: the map.
            own_sigma_m: that is added in the plane where a map has no joint covariance: s_drift.
            n_dimensions: 2 or 3.
        """
        joint = landmarks.joint
        if joint is None:
            own = landmarks.covariance_m2.copy()
            own[:, [0, 1], [0, 1]] += own_sigma_m**2
            joint = JointCovariance(own, np.zeros((len(landmarks), 0, 3)))
        return cls(landmarks.position_m[:, :n_dimensions], joint, landmarks.calibration)


class TransformedLandmarks(NamedTuple):
    """What a map says of some landmarks, at a guess of the unknowns.

    Attributes:
        y_m: (n, D) where they are, in the common frame.
        own_m2: (n, D, D) covariance of their own errors, there.
        information: (n, D, D) its inverse.
        by_unknown: (n, D, U_k) dy / du by the unknowns that it depends on.
    """

    y_m: Float
    own_m2: Float
    information: Float
    by_unknown: Float


class LandmarkRows(NamedTuple):
    """Some of a map's landmarks as they enter each step.

    Attributes:
        position_m: (n, D).
        own_m2: (n, D, D).
        information: (n, D, D) its inverse.
        moved_m: (n, D, R) how far one sigma of each shared variable moves them, but for the camera.
        calibration: the camera's.
    """

    position_m: Float
    own_m2: Float
    information: Float
    moved_m: Float
    calibration: CalibrationError

    @classmethod
    def of(cls, own_map: JointMap, rows: np.ndarray) -> "LandmarkRows":
        """The landmarks `rows` (n,) of a map."""
        position = own_map.position_m[rows]
        d, joint = position.shape[1], own_map.joint
        own = joint.own_m2[rows][:, :d, :d]
        moved = np.swapaxes(joint.common_m[rows][:, :, :d], 1, 2)
        return cls(position, own, inverses(own), np.ascontiguousarray(moved), own_map.calibration)


def transform_landmarks(
    own: LandmarkRows, T: Float, shared: Float, arm_m: Float
) -> TransformedLandmarks:
    """What a map says of its rows under its motion and shared variables.

    The camera's errors move points at `arm_m` (n, D).
    """
    (n, d), moved = own.position_m.shape, own.moved_m
    if not own.calibration.is_none:
        by_camera = own.calibration.moves_m(arm_m)[:, :, :d]
        moved = np.concatenate([moved, np.swapaxes(by_camera, 1, 2)], axis=2)
    R = rotation_about_z(T[2])[:d, :d]
    point = own.position_m + (moved.reshape(n * d, len(shared)) @ shared).reshape(n, d)
    by = np.empty((n, d, 3 + len(shared)))
    by[:, :2, :3], by[:, 2:, :3] = motion_jacobian(T, point), 0.0
    np.matmul(R, moved, out=by[:, :, 3:])
    turned = R @ own.own_m2 @ R.T, R @ own.information @ R.T
    return TransformedLandmarks(transform_points(T, point), *turned, by)


def weighted_information(transformed: TransformedLandmarks, weight: Float) -> Float:
    """W (n, D, D)."""
    return weight[:, None, None] * transformed.information


# The next step would move what is sought, as a whole and in squared sigmas, by no more than this.
_CONVERGED = 1e-3
_MOST_STEPS = 50


@dataclass(frozen=True)
class JointEstimate:
    """K maps in the frame of the first.

    Attributes:
        T_first_map: (K, 3), the first is no motion.
        shared: of each map, (R_k,) its shared variables z.
        covariance: (U, U) of all unknowns: three for each motion but the first, then the z.
        weight: (C, K) of the Student-t, as information; 0 where a map has no part.
        dof: degrees of freedom of the Student-t.
    """

    T_first_map: Float
    shared: tuple[Float, ...]
    covariance: Float
    weight: Float
    dof: float

    @property
    def motion_covariance(self) -> Float:
        """(K, 3, 3) of each motion; the first is known."""
        found = np.zeros((len(self.T_first_map), 3, 3))
        for k in range(1, len(found)):
            own = slice(3 * k - 3, 3 * k)
            found[k] = self.covariance[own, own]
        return found

    def transformed(
        self, maps: Sequence[JointMap], k: int, rows: np.ndarray
    ) -> TransformedLandmarks:
        """What map k says of its landmarks `rows` (n,), by its own unknowns: see `unknowns`."""
        own = LandmarkRows.of(maps[k], rows)
        return transform_landmarks(own, self.T_first_map[k], self.shared[k], own.position_m)

    def unknowns(self, maps: Sequence[JointMap], k: int) -> np.ndarray:
        """(U_k,) where those that map k depends on stand among all, ABSENT for none."""
        return _columns(maps)[k]

    def moved_m(
        self, maps: Sequence[JointMap], k: int, transformed: TransformedLandmarks, factor: Float
    ) -> Float:
        """(n, D, U) how far a sigma of each independent variable moves what map k says.

        These are the columns of a lower triangular `factor` (U, U) of the unknowns' covariance.
        """
        columns = self.unknowns(maps, k)
        known = columns != ABSENT
        by = transformed.by_unknown[:, :, known].reshape(
            transformed.y_m.size, np.count_nonzero(known)
        )
        n = 1 + int(columns.max(initial=ABSENT))  # what comes after them in the factor is zero
        moved = np.zeros((transformed.y_m.size, len(factor)))
        np.matmul(by, factor[columns[known], :n], out=moved[:, :n])
        return moved.reshape(*transformed.y_m.shape, len(factor))


def _columns(maps: Sequence[JointMap]) -> list[np.ndarray]:
    """Where in u motion and shared variables of each map stand; the first map's motion nowhere."""
    first, of_camera, found = 3 * (len(maps) - 1), dict[str, np.ndarray](), list[np.ndarray]()
    for k, own in enumerate(maps):
        motion = np.arange(3 * k - 3, 3 * k) if k else np.full(3, ABSENT)
        name = "" if own.calibration.is_none else own.calibration.camera
        known = of_camera.get(name, np.empty(0, np.int64))
        shared = np.arange(first, first + own.n_shared - len(known))
        first += len(shared)
        found.append(np.concatenate([motion, shared, known]))
        if name:
            of_camera[name] = found[-1][-N_OF_CAMERA:]
    return found


def estimate_jointly(
    maps: Sequence[JointMap], T_first_map: Float, parents: np.ndarray
) -> JointEstimate:
    """Gauss-Newton steps from given motions, each with new weights.

    Args:
        maps: K of them.
        T_first_map: (K, 3) where to start from; the first stays.
        parents: (C, K) rows of the maps that are one point, ABSENT for none; points of one map
            alone say nothing here.
    """
    T, shared = np.array(T_first_map), [np.zeros(each.n_shared) for each in maps]
    columns = _columns(maps)
    has = parents != ABSENT
    rows = [LandmarkRows.of(own, parents[has[:, k], k]) for k, own in enumerate(maps)]
    weight, dof, n_steps = has.astype(np.float64), MOST_DOF, 0
    transformed = _all_said(rows, T, shared, has, weight)
    while True:
        points = _points(transformed, has, weight)
        A, gradient = _equations(transformed, has, weight, points, columns, shared)
        factor = scipy.linalg.cholesky(A, lower=True)
        step = -scipy.linalg.cho_solve((factor, True), gradient)
        moved = float(np.sum((factor.T @ step) ** 2))
        if n_steps == _MOST_STEPS or moved < _CONVERGED:
            share = float(information_share(dof, maps[0].position_m.shape[1]))
            weight *= share
            A *= share
            z = _shared(columns)
            A[z, z] += 1.0 - share  # what was known of them before is all there
            covariance = scipy.linalg.inv(A)
            return JointEstimate(T, tuple(shared), covariance, weight, dof)
        for k, own in enumerate(columns):
            shared[k] = shared[k] + step[own[3:]]
            if k:
                T[k] += step[own[:3]]
        T[:, 2] = wrap(T[:, 2])
        transformed = _all_said(rows, T, shared, has, weight)
        weight, dof = _reweighted(transformed, has, weight, dof)
        if not all(own.calibration.is_none for own in maps):
            transformed = _all_said(rows, T, shared, has, weight)  # from where points are seen now
        n_steps += 1


def _all_said(
    rows: Sequence[LandmarkRows], T: Float, shared: Sequence[Float], has: np.ndarray, weight: Float
) -> list[TransformedLandmarks]:
    """What each map says of its `rows`.

    Errors of cameras move points from where all maps together see them. Moved from where the one
    map does, they would move its noise too, and all maps shrink, since that shrinks residuals.
    """
    transformed = [
        transform_landmarks(*each, each[0].position_m) for each in zip(rows, T, shared, strict=True)
    ]
    if all(own.calibration.is_none for own in rows):
        return transformed
    g = _points(transformed, has, weight).g_m
    arms = [transform_points(inverse(T[k]), g[has[:, k]]) for k in range(len(rows))]
    return list(map(transform_landmarks, rows, T, shared, arms))


class _Points(NamedTuple):
    """Points g (C, D) as the weighted means of what maps say, and their covariances V (C, D, D)."""

    g_m: Float
    covariance_m2: Float


def _points(transformed: Sequence[TransformedLandmarks], has: np.ndarray, weight: Float) -> _Points:
    n_dimensions = transformed[0].y_m.shape[1]
    information = np.zeros((len(has), n_dimensions, n_dimensions))
    total = np.zeros((len(has), n_dimensions))
    for k, own in enumerate(transformed):
        W = weighted_information(own, weight[has[:, k], k])
        information[has[:, k]] += W
        total[has[:, k]] += np.einsum("nij,nj->ni", W, own.y_m)
    V = inverses(information)
    return _Points(np.einsum("nij,nj->ni", V, total), V)


def _equations(
    transformed: Sequence[TransformedLandmarks],
    has: np.ndarray,
    weight: Float,
    points: _Points,
    columns: Sequence[np.ndarray],
    shared: Sequence[Float],
) -> tuple[Float, Float]:
    """The normal equations of a step: matrix (U, U) and gradient (U,)."""
    n_unknowns = 1 + max(int(own.max(initial=ABSENT)) for own in columns)
    A, gradient = np.zeros((n_unknowns + 1,) * 2), np.zeros(n_unknowns + 1)  # the last: ABSENT
    W = [weighted_information(own, weight[has[:, k], k]) for k, own in enumerate(transformed)]
    for k, own in enumerate(transformed):
        off = own.y_m - points.g_m[has[:, k]]
        pulled = (W[k] @ off[:, :, None]).ravel()
        gradient[columns[k]] += own.by_unknown.reshape(-1, len(columns[k])).T @ pulled
        by, its = own.by_unknown, columns[k]
        between = W[k] - W[k] @ points.covariance_m2[has[:, k]] @ W[k]
        A[np.ix_(its, its)] += by.reshape(-1, len(its)).T @ (between @ by).reshape(-1, len(its))
        for m, other in enumerate(transformed[:k]):
            both = has[:, k] & has[:, m]
            here, there = both[has[:, k]], both[has[:, m]]
            between = -W[k][here] @ points.covariance_m2[both] @ W[m][there]
            left = by[here].reshape(-1, len(its))
            right = between @ other.by_unknown[there]
            block = left.T @ right.reshape(-1, len(columns[m]))
            A[np.ix_(its, columns[m])] += block
            A[np.ix_(columns[m], its)] += block.T
    z = _shared(columns)
    A[z, z] += 1.0
    value = np.zeros_like(gradient)
    for own, its in zip(columns, shared, strict=True):
        value[own[3:]] = its
    return A[:-1, :-1], (gradient + value)[:-1]


def _shared(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Where in u the shared variables of all maps stand."""
    return np.unique(np.concatenate([own[3:] for own in columns]))


def _reweighted(
    transformed: Sequence[TransformedLandmarks], has: np.ndarray, weight: Float, dof: float
) -> tuple[Float, float]:
    """Weights (C, K) of the Student-t, and its degrees of freedom, for what is off now.

    Those so far are near the new ones.

    The squares are those expected about the true points (the E step of Lange et al., 1989).
    """
    new, points = np.zeros_like(weight), _points(transformed, has, weight)
    n_dimensions = points.g_m.shape[1]
    dof = fit_dof(
        _disagreement(transformed, has), n_dimensions * (np.count_nonzero(has, axis=1) - 1), dof
    )
    for k, own in enumerate(transformed):
        off = own.y_m - points.g_m[has[:, k]]
        spread = off[:, :, None] * off[:, None, :] + points.covariance_m2[has[:, k]]
        squares = np.einsum("nij,nij->n", own.information, spread)
        new[has[:, k], k] = student_weights(squares, dof, n_dimensions)
    return new, dof


def _disagreement(transformed: Sequence[TransformedLandmarks], has: np.ndarray) -> Float:
    """(C,) how far what maps say of a point lies from its mean, all with their whole weight.

    Of M maps in D dimensions a chi-square with D (M - 1) degrees of freedom, if Gaussian.
    """
    points, total = _points(transformed, has, has.astype(np.float64)), np.zeros(len(has))
    for k, own in enumerate(transformed):
        off = own.y_m - points.g_m[has[:, k]]
        total[has[:, k]] += np.einsum("ni,nij,nj->n", off, own.information, off)
    return total
