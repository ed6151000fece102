"""The rigid links in NumPy and SciPy, all starts at once; an obvious damped least squares."""

import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.vision.visual_odometry import (
    _ALL_AFTER,
    _OPEN,
    _STEPS,
    _TOLERANCES_M,
    MIN_LINKS,
    starts,
)


def rigid_links_twin(
    p_before_m: Float,
    covariance_before_m2: Float,
    p_after_m: Float,
    covariance_after_m2: Float,
    probability: float,
) -> tuple[np.ndarray, Float | None]:
    """See `rigid_links`; of the motion its T_before_after (4, 4) alone."""
    n = len(p_before_m)
    if n < MIN_LINKS:
        return np.ones(n, dtype=bool), None
    gate = chi_square_bound(probability, 3)
    start = starts(p_before_m)
    agree, R, t = start, np.tile(np.eye(3), (len(start), 1, 1)), np.zeros((len(start), 3))
    for i, tolerance_m in enumerate(_TOLERANCES_M):
        S_before = covariance_before_m2 + tolerance_m**2 * np.eye(3)
        for _ in range(_STEPS):
            R, t, square = _step(R, t, agree, p_before_m, S_before, p_after_m, covariance_after_m2)
        agree = np.less_equal(square, gate)
        if i < _ALL_AFTER:
            agree &= start
    best = np.argmax(agree.sum(axis=1))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R[best], t[best]
    return agree[best], T if agree[best].sum() >= MIN_LINKS else None


def _step(
    R: Float,
    t: Float,
    used: np.ndarray,
    p_before: Float,
    S_before: Float,
    p_after: Float,
    S_after: Float,
) -> tuple[Float, Float, Float]:
    """A Gauss-Newton step for B motions (B, 3, 3) and (B, 3), each over its own links (B, N).

    Returns:
        The motions, and all squared distances (B, N) after the step.
    """
    turn = R[:, None]
    information = np.linalg.inv(S_before + turn @ S_after @ turn.swapaxes(-1, -2))
    arm = p_after @ R.swapaxes(-1, -2)
    residual = p_before - arm - t[:, None]
    jacobian = np.zeros((*used.shape, 3, 6))  # d(moved point) / d(shift, turn)
    jacobian[..., :3] = np.eye(3)
    for k in range(3):
        jacobian[..., 3 + k] = np.cross(np.eye(3)[k], arm)
    weighted = used[..., None, None] * (jacobian.swapaxes(-1, -2) @ information)
    normal = np.sum(weighted @ jacobian, axis=1)
    normal = normal + _OPEN * np.eye(6) * normal
    right = np.sum(weighted @ residual[..., None], axis=1)
    some = used.any(axis=1)
    step = np.zeros((len(used), 6))
    step[some] = np.linalg.solve(normal[some], right[some])[..., 0]
    residual = residual - (jacobian @ step[:, None, :, None])[..., 0]
    square = np.sum(residual * (information @ residual[..., None])[..., 0], axis=-1)
    return Rotation.from_rotvec(step[:, 3:]).as_matrix() @ R, t + step[:, :3], square
