"""From a motion and the pairs it was fitted to, to a whole answer: for aligners of others."""

import time

import numpy as np

from mapfusion.align.pairs import Pairs, finish, undetermined, why_one_place
from mapfusion.align.result import Alignment, Status
from mapfusion.align.rigid import least_squares_gain
from mapfusion.se2 import Float


def supported_by(
    pairs: Pairs, inlier: np.ndarray, T_a_b: Float, started_s: float, refusal: str = ""
) -> Alignment:
    """The answer of a method whose motion is the least squares, equally weighted, of some pairs.

    Covariance and s_drift are judged from those pairs' residuals. Fewer than three of them are a
    refusal; all in one place, they leave the angle open.

    Args:
        pairs: all that were given, from `pairs.gather`.
        inlier: (N,) bool, which of them the motion was fitted to.
        T_a_b: (3,) finite.
        started_s: `time.perf_counter()` at the start.
        refusal: why the estimate is not to be trusted, if so.
    """
    n_inliers = int(np.count_nonzero(inlier))
    if n_inliers < 2:
        reason = refusal or f"{n_inliers} correspondences support the motion"
        return Alignment(
            T_a_b,
            np.full((3, 3), np.nan),
            inlier,
            time.perf_counter() - started_s,
            Status.REFUSED,
            reason,
        )
    fitted = pairs[inlier]
    reason = why_one_place(fitted)
    if reason:
        return undetermined(reason, len(pairs), started_s)
    gain = least_squares_gain(T_a_b, fitted.p_b)
    return finish(fitted, gain, T_a_b, inlier, started_s, refusal)
