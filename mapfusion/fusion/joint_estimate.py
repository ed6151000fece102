"""Joint least squares of maps with joint covariances.

The landmarks of map k are x = m + C' z_k + e (`joint_covariance.py`) with standard normal shared
variables z_k and independent errors e. Landmarks of several maps that are the same point g have

    T_k (m + C' z_k + e) = g,    so that    y_k(u) = T_k (m + C' z_k) = g - R_k e.

The unknowns are u = (T_1, ..., z_0, z_1, ...). Their number does not depend on that of landmarks.
For given u each point is a weighted mean, and is eliminated:

    g = V sum W_k y_k,   V = (sum W_k)^-1,    cost = |z|^2 + sum (y_k - g)' W_k (y_k - g)

W_k is the inverse covariance of R_k e, times the weight of a Student-t distribution, because
associations may be false. The frame is that of the first map, so T_0 is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.camera import EXACT, N_OF_CAMERA, CalibrationError
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float, inverses
from mapfusion.geometry.se2 import (
    inverse,
    motion_jacobian,
    rotation_about_z,
    transform_points,
    wrap,
)
from mapfusion.landmark_map import LandmarkMap
from mapfusion.smoother.robust_loss import MOST_DOF, fit_dof, information_share, student_weights


@dataclass(frozen=True)
class JointMap:
    """N landmarks of a map with their joint covariance.

    Attributes:
        position_m: positions, shape (N, D); D is 2 for planar maps.
        joint: joint covariance of the positions in three dimensions, without the calibration.
        calibration: calibration error of the camera. Unless it is zero it adds two shared
            variables, which are the last ones and common to all maps of the camera.
    """

    position_m: Float
    joint: JointCovariance
    calibration: CalibrationError = EXACT

    def __len__(self) -> int:
        return len(self.position_m)

    @property
    def n_shared(self) -> int:
        """Number of shared variables R."""
        return self.joint.rank + (0 if self.calibration.is_none else N_OF_CAMERA)

    @classmethod
    def of(
        cls, landmarks: LandmarkMap, own_sigma_m: float, height_sigma_m: float, n_dimensions: int
    ) -> "JointMap":
        """Convert a map.

        Args:
            landmarks: the map.
            own_sigma_m: s_drift, standard deviation of an independent error of x and y that is
                added if the map has no joint covariance.
            height_sigma_m: the same of z.
            n_dimensions: 2 or 3.
        """
        joint = landmarks.joint
        if joint is None:
            own_m2 = landmarks.covariance_m2.copy()
            own_m2[:, [0, 1], [0, 1]] += own_sigma_m**2
            own_m2[:, 2, 2] += height_sigma_m**2
            joint = JointCovariance(own_m2, np.zeros((len(landmarks), 0, 3)))
        return cls(landmarks.position_m[:, :n_dimensions], joint, landmarks.calibration)


class TransformedLandmarks(NamedTuple):
    """Landmarks of a map in the common frame, for given unknowns.

    Attributes:
        y_m: positions, shape (n, D).
        own_m2: covariances of the independent errors, shape (n, D, D).
        information: inverses of these covariances, shape (n, D, D).
        by_unknown: Jacobians dy / du by the unknowns of the map, shape (n, D, U_k).
    """

    y_m: Float
    own_m2: Float
    information: Float
    by_unknown: Float


class LandmarkRows(NamedTuple):
    """Selected landmarks of a map in its own frame.

    Attributes:
        position_m: positions, shape (n, D).
        own_m2: covariances of the independent errors, shape (n, D, D).
        information: inverses of these covariances, shape (n, D, D).
        moved_m: displacement by one sigma of each shared variable without those of the camera,
            shape (n, D, R).
        calibration: calibration error of the camera.
    """

    position_m: Float
    own_m2: Float
    information: Float
    moved_m: Float
    calibration: CalibrationError

    @classmethod
    def of(cls, own_map: JointMap, rows: np.ndarray) -> "LandmarkRows":
        """Return the landmarks `rows` (n,) of a map."""
        position = own_map.position_m[rows]
        d, joint = position.shape[1], own_map.joint
        own_m2 = joint.own_m2[rows][:, :d, :d]
        moved = np.swapaxes(joint.common_m[rows][:, :, :d], 1, 2)
        return cls(
            position, own_m2, inverses(own_m2), np.ascontiguousarray(moved), own_map.calibration
        )


def transform_landmarks(
    landmarks: LandmarkRows, T: Float, shared_coefficients: Float, arm_m: Float
) -> TransformedLandmarks:
    """Transform landmarks into the common frame.

    Args:
        landmarks: landmarks of a map.
        T: pose of the map, shape (3,).
        shared_coefficients: shared variables of the map, shape (R,).
        arm_m: positions in the map that the errors of the camera displace, shape (n, D).
    """
    (n, d), moved = landmarks.position_m.shape, landmarks.moved_m
    if not landmarks.calibration.is_none:
        by_camera = landmarks.calibration.moves_m(arm_m)[:, :, :d]
        moved = np.concatenate([moved, np.swapaxes(by_camera, 1, 2)], axis=2)
    R = rotation_about_z(T[2])[:d, :d]
    point = landmarks.position_m + (
        moved.reshape(n * d, len(shared_coefficients)) @ shared_coefficients
    ).reshape(n, d)
    by = np.empty((n, d, 3 + len(shared_coefficients)))
    by[:, :2, :3], by[:, 2:, :3] = motion_jacobian(T, point), 0.0
    np.matmul(R, moved, out=by[:, :, 3:])
    turned = R @ landmarks.own_m2 @ R.T, R @ landmarks.information @ R.T
    return TransformedLandmarks(transform_points(T, point), *turned, by)


def weighted_information(transformed: TransformedLandmarks, weight: Float) -> Float:
    """Return W, shape (n, D, D)."""
    return weight[:, None, None] * transformed.information


# Convergence tolerance: squared length of the next step in sigmas.
_CONVERGED = 1e-6
_MOST_STEPS = 50


@dataclass(frozen=True)
class JointEstimate:
    """Poses and shared variables of K maps in the frame of the first.

    Attributes:
        T_first_map: poses, shape (K, 3); the first is the identity.
        shared: shared variables z of each map, shape (R_k,).
        covariance: covariance of all unknowns, shape (U, U): three for each pose except the first,
            then the shared variables.
        weight: factors of the Student-t distribution on the information, shape (C, K); 0 if the
            map lacks the point.
        dof: degrees of freedom of the Student-t distribution.
    """

    T_first_map: Float
    shared: tuple[Float, ...]
    covariance: Float
    weight: Float
    dof: float

    @property
    def motion_covariance(self) -> Float:
        """Covariances of the poses, shape (K, 3, 3); zero for the first."""
        covariances = np.zeros((len(self.T_first_map), 3, 3))
        for k in range(1, len(covariances)):
            rows = slice(3 * k - 3, 3 * k)
            covariances[k] = self.covariance[rows, rows]
        return covariances

    def transformed(
        self, maps: Sequence[JointMap], k: int, rows: np.ndarray
    ) -> TransformedLandmarks:
        """Transform the landmarks `rows` (n,) of map k into the common frame."""
        landmark_rows = LandmarkRows.of(maps[k], rows)
        return transform_landmarks(
            landmark_rows, self.T_first_map[k], self.shared[k], landmark_rows.position_m
        )

    def unknowns(self, maps: Sequence[JointMap], k: int) -> np.ndarray:
        """Return the indices (U_k,) of map k's unknowns in u; ABSENT for the known first pose."""
        return _columns(maps)[k]

    def moved_m(
        self, maps: Sequence[JointMap], k: int, transformed: TransformedLandmarks, factor: Float
    ) -> Float:
        """Return the displacement by independent unit variables, shape (n, D, U).

        Args:
            maps: all maps.
            k: index of the map.
            transformed: landmarks of map k in the common frame.
            factor: lower triangular factor (U, U) of the unknowns' covariance.
        """
        columns = self.unknowns(maps, k)
        is_unknown = columns != ABSENT
        by = transformed.by_unknown[:, :, is_unknown].reshape(
            transformed.y_m.size, np.count_nonzero(is_unknown)
        )
        n = 1 + int(columns.max(initial=ABSENT))  # later columns of the factor are zero
        moved = np.zeros((transformed.y_m.size, len(factor)))
        np.matmul(by, factor[columns[is_unknown], :n], out=moved[:, :n])
        return moved.reshape(*transformed.y_m.shape, len(factor))


def _columns(maps: Sequence[JointMap]) -> list[np.ndarray]:
    """Return the indices of each map's unknowns in u; ABSENT for the pose of the first map."""
    first, of_camera, columns = 3 * (len(maps) - 1), dict[str, np.ndarray](), list[np.ndarray]()
    for k, landmark_map in enumerate(maps):
        motion = np.arange(3 * k - 3, 3 * k) if k else np.full(3, ABSENT)
        name = "" if landmark_map.calibration.is_none else landmark_map.calibration.camera
        columns_of_camera = of_camera.get(name, np.empty(0, np.int64))
        shared_columns = np.arange(first, first + landmark_map.n_shared - len(columns_of_camera))
        first += len(shared_columns)
        columns.append(np.concatenate([motion, shared_columns, columns_of_camera]))
        if name:
            of_camera[name] = columns[-1][-N_OF_CAMERA:]
    return columns


def estimate_jointly(
    maps: Sequence[JointMap], T_first_map: Float, parents: np.ndarray
) -> JointEstimate:
    """Compute the estimate by Gauss-Newton steps with robust weights.

    Args:
        maps: K maps.
        T_first_map: initial poses, shape (K, 3); the first does not change.
        parents: rows of each point's landmarks in the maps, shape (C, K), ABSENT for none; each
            point has landmarks of at least two maps.
    """
    T, shared_coefficients = np.array(T_first_map), [np.zeros(each.n_shared) for each in maps]
    columns = _columns(maps)
    has_parent = parents != ABSENT
    rows = [
        LandmarkRows.of(each_map, parents[has_parent[:, k], k]) for k, each_map in enumerate(maps)
    ]
    weight, dof, n_steps = has_parent.astype(np.float64), MOST_DOF, 0
    transformed = _transform_all(rows, T, shared_coefficients, has_parent, weight)
    while True:
        points = _points(transformed, has_parent, weight)
        A, gradient = _equations(
            transformed, has_parent, weight, points, columns, shared_coefficients
        )
        factor = scipy.linalg.cholesky(A, lower=True)
        step = -scipy.linalg.cho_solve((factor, True), gradient)
        moved = float(np.sum((factor.T @ step) ** 2))
        if n_steps == _MOST_STEPS or moved < _CONVERGED:
            share = float(information_share(dof, maps[0].position_m.shape[1]))
            weight *= share
            A *= share
            z = _shared(columns)
            A[z, z] += 1.0 - share  # the prior is not scaled
            covariance = scipy.linalg.inv(A)
            return JointEstimate(T, tuple(shared_coefficients), covariance, weight, dof)
        for k, each_map in enumerate(columns):
            shared_coefficients[k] = shared_coefficients[k] + step[each_map[3:]]
            if k:
                T[k] += step[each_map[:3]]
        T[:, 2] = wrap(T[:, 2])
        transformed = _transform_all(rows, T, shared_coefficients, has_parent, weight)
        weight, dof = _update_weights(transformed, has_parent, weight, dof)
        if not all(each_map.calibration.is_none for each_map in maps):
            transformed = _transform_all(
                rows, T, shared_coefficients, has_parent, weight
            )  # at the new points
        n_steps += 1


def _transform_all(
    rows: Sequence[LandmarkRows],
    T: Float,
    shared_coefficients: Sequence[Float],
    has_parent: np.ndarray,
    weight: Float,
) -> list[TransformedLandmarks]:
    """Transform the landmarks of all maps into the common frame.

    Errors of a camera displace the estimated points. If they displaced the observed landmarks,
    their noise would be scaled as well, and the maps would shrink to reduce the residuals.
    """
    transformed = [
        transform_landmarks(*each, each[0].position_m)
        for each in zip(rows, T, shared_coefficients, strict=True)
    ]
    if all(map_rows.calibration.is_none for map_rows in rows):
        return transformed
    g = _points(transformed, has_parent, weight).g_m
    arms = [transform_points(inverse(T[k]), g[has_parent[:, k]]) for k in range(len(rows))]
    return list(map(transform_landmarks, rows, T, shared_coefficients, arms))


class _Points(NamedTuple):
    """Weighted means of the landmarks of each point.

    Attributes:
        g_m: positions g, shape (C, D).
        covariance_m2: covariances V, shape (C, D, D).
    """

    g_m: Float
    covariance_m2: Float


def _points(
    transformed: Sequence[TransformedLandmarks], has_parent: np.ndarray, weight: Float
) -> _Points:
    n_dimensions = transformed[0].y_m.shape[1]
    information = np.zeros((len(has_parent), n_dimensions, n_dimensions))
    total = np.zeros((len(has_parent), n_dimensions))
    for k, map_landmarks in enumerate(transformed):
        W = weighted_information(map_landmarks, weight[has_parent[:, k], k])
        information[has_parent[:, k]] += W
        total[has_parent[:, k]] += np.einsum("nij,nj->ni", W, map_landmarks.y_m)
    V = inverses(information)
    return _Points(np.einsum("nij,nj->ni", V, total), V)


def _equations(
    transformed: Sequence[TransformedLandmarks],
    has_parent: np.ndarray,
    weight: Float,
    points: _Points,
    columns: Sequence[np.ndarray],
    shared_coefficients: Sequence[Float],
) -> tuple[Float, Float]:
    """Return the normal equations of a step: matrix (U, U) and gradient (U,)."""
    n_unknowns = 1 + max(int(each_map.max(initial=ABSENT)) for each_map in columns)
    A, gradient = np.zeros((n_unknowns + 1,) * 2), np.zeros(n_unknowns + 1)  # last: ABSENT
    W = [
        weighted_information(each_map, weight[has_parent[:, k], k])
        for k, each_map in enumerate(transformed)
    ]
    for k, each_map in enumerate(transformed):
        residual = each_map.y_m - points.g_m[has_parent[:, k]]
        weighted = (W[k] @ residual[:, :, None]).ravel()
        gradient[columns[k]] += each_map.by_unknown.reshape(-1, len(columns[k])).T @ weighted
        by, its = each_map.by_unknown, columns[k]
        between = W[k] - W[k] @ points.covariance_m2[has_parent[:, k]] @ W[k]
        A[np.ix_(its, its)] += by.reshape(-1, len(its)).T @ (between @ by).reshape(-1, len(its))
        for m, other in enumerate(transformed[:k]):
            in_both = has_parent[:, k] & has_parent[:, m]
            in_k, in_m = in_both[has_parent[:, k]], in_both[has_parent[:, m]]
            between = -W[k][in_k] @ points.covariance_m2[in_both] @ W[m][in_m]
            left = by[in_k].reshape(-1, len(its))
            right = between @ other.by_unknown[in_m]
            block = left.T @ right.reshape(-1, len(columns[m]))
            A[np.ix_(its, columns[m])] += block
            A[np.ix_(columns[m], its)] += block.T
    z = _shared(columns)
    A[z, z] += 1.0
    value = np.zeros_like(gradient)
    for each_map, its in zip(columns, shared_coefficients, strict=True):
        value[each_map[3:]] = its
    return A[:-1, :-1], (gradient + value)[:-1]


def _shared(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Return the indices of the shared variables in u."""
    return np.unique(np.concatenate([map_columns[3:] for map_columns in columns]))


def _update_weights(
    transformed: Sequence[TransformedLandmarks], has_parent: np.ndarray, weight: Float, dof: float
) -> tuple[Float, float]:
    """Compute new weights (C, K) and degrees of freedom of the Student-t distribution.

    The degrees of freedom are fitted to the distances of the landmarks from their unweighted mean.
    If they are Gaussian, the sum for M maps in D dimensions has a chi-square distribution with
    D (M - 1) degrees of freedom. The weights are those of the squares about the true points (E step
    of Lange et al., 1989).
    """
    unweighted = _points(transformed, has_parent, has_parent.astype(np.float64))
    total = np.zeros(len(has_parent))
    for k, map_landmarks in enumerate(transformed):
        residual = map_landmarks.y_m - unweighted.g_m[has_parent[:, k]]
        total[has_parent[:, k]] += np.einsum(
            "ni,nij,nj->n", residual, map_landmarks.information, residual
        )
    n_dimensions = unweighted.g_m.shape[1]
    dof = fit_dof(total, n_dimensions * (np.count_nonzero(has_parent, axis=1) - 1), dof)

    new, points = np.zeros_like(weight), _points(transformed, has_parent, weight)
    for k, map_landmarks in enumerate(transformed):
        residual = map_landmarks.y_m - points.g_m[has_parent[:, k]]
        spread = (
            residual[:, :, None] * residual[:, None, :] + points.covariance_m2[has_parent[:, k]]
        )
        squares = np.einsum("nij,nij->n", map_landmarks.information, spread)
        new[has_parent[:, k], k] = student_weights(squares, dof, n_dimensions)
    return new, dof
