"""Which links between two frames one motion of the robot explains; the others are slips.

A corner may jump along an edge, sit where one wall ends before another, or belong to something that
moves. Such links look like the others, descriptor by descriptor, and err by several pixels where
the rest errs by a tenth; one in twenty is enough to turn a map. The world stands still, so all true
links agree on one motion in the plane.
"""

import numpy as np

from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float, rotation, rotation_about_z

_MIN_LINKS = 4  # two links determine a motion; one slip among three would be anyone's guess
# Added to the noise: from a tolerance beside which all points are equally certain to none.
_TOLERANCES_M = (1.0, 0.25, 0.06, 0.015, 0.004, 0.001, 0.0)
_ALL_AFTER = 3  # place in it after which all links are used, whatever the start left out
_STEPS = 2  # of Gauss-Newton at each tolerance; the answer of the one before is near
_PARTS = 3  # near, middle and far links; each start but one leaves one of them out


def rigid_links(
    p_before_m: Float,
    covariance_before_m2: Float,
    p_after_m: Float,
    covariance_after_m2: Float,
    probability: float,
) -> np.ndarray:
    """Links (N,) bool that agree with the motion on which most agree.

    Least squares over the links inside the gate, again and again, while a tolerance that is added
    to all covariances falls from far above the noise to nothing. At first every link has one vote;
    at last each counts by its own precision. That finds the motion in spite of slips anywhere, but
    not always of another robot nearby: some points known to a millimetre pull at one end, where a
    wall at one distance leaves open whether the robot turned or slid. So there are four starts, of
    all links and without the near, the middle and the far third; that with most links wins.
    Points (N, 3) are in the robot frame of either frame; all True where fewer than four links leave
    nothing to compare.
    """
    n = len(p_before_m)
    if n < _MIN_LINKS:
        return np.ones(n, dtype=bool)
    gate = chi_square_bound(probability, 3)
    by_distance = np.argsort(np.argsort(np.linalg.norm(p_before_m, axis=1), kind="stable"))
    part = by_distance * _PARTS // n
    left_out = np.array([-1, *range(_PARTS)])[:, None]
    start = np.not_equal(part, left_out)  # (B, N); the first leaves out none
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
