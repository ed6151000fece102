"""The rigid links in NumPy, all starts at once; the normal matrix by its pseudo-inverse."""

import numpy as np

from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float, rotation, rotation_about_z
from mapfusion.vision.rigid_links import _ALL_AFTER, _MIN_LINKS, _STEPS, _TOLERANCES_M, starts


def rigid_links_twin(
    p_before_m: Float,
    covariance_before_m2: Float,
    p_after_m: Float,
    covariance_after_m2: Float,
    probability: float,
) -> np.ndarray:
    """See `rigid_links`."""
    n = len(p_before_m)
    if n < _MIN_LINKS:
        return np.ones(n, dtype=bool)
    gate = chi_square_bound(probability, 3)
    start = starts(p_before_m)
    motion, agree = np.zeros((len(start), 3)), start
    for i, tolerance_m in enumerate(_TOLERANCES_M):
        S_before = covariance_before_m2 + tolerance_m**2 * np.eye(3)
        for _ in range(_STEPS):
            motion, square = _step(
                motion, agree, p_before_m, S_before, p_after_m, covariance_after_m2
            )
        agree = np.less_equal(square, gate)
        if i < _ALL_AFTER:
            agree &= start
    return agree[np.argmax(agree.sum(axis=1))]


def _step(
    motion: Float,
    used: np.ndarray,
    p_before: Float,
    S_before: Float,
    p_after: Float,
    S_after: Float,
) -> tuple[Float, Float]:
    """A Gauss-Newton step for B motions T_before_after (B, 3), each over its own links (B, N).

    Returns:
        The motions, and all squared distances (B, N) after the step.
    """
    turn = rotation_about_z(motion[:, 2])[:, None]
    information = np.linalg.inv(S_before + turn @ S_after @ turn.swapaxes(-1, -2))
    arm = p_after[:, :2] @ rotation(motion[:, 2]).swapaxes(-1, -2)
    residual = np.empty((*used.shape, 3))
    residual[..., :2] = p_before[:, :2] - arm - motion[:, None, :2]
    residual[..., 2] = p_before[:, 2] - p_after[:, 2]
    jacobian = np.zeros((*used.shape, 3, 3))  # d(moved point) / d(x, y, theta)
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1
    jacobian[..., 0, 2], jacobian[..., 1, 2] = -arm[..., 1], arm[..., 0]
    weighted = used[..., None, None] * (jacobian.swapaxes(-1, -2) @ information)
    normal = np.sum(weighted @ jacobian, axis=1)
    right = np.sum(weighted @ residual[..., None], axis=1)
    # the pseudo-inverse: points on one line of sight, or too few, leave a direction open
    step = (np.linalg.pinv(normal, hermitian=True) @ right)[..., 0]
    residual = residual - (jacobian @ step[:, None, :, None])[..., 0]
    square = np.sum(residual * (information @ residual[..., None])[..., 0], axis=-1)
    return motion + step, square
