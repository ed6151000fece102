"""From another package's motion and supporters to an Alignment."""

import numpy as np

from mapfusion.align.pairs import Pairs, finish, undetermined, why_one_place
from mapfusion.align.result import Alignment
from mapfusion.align.rigid import least_squares_gain
from mapfusion.se2 import Float


def answer(pairs: Pairs, T_a_b: Float, inlier: np.ndarray, started_s: float) -> Alignment:
    """The motion (3,), with drift and covariance as those of least squares on its supporters (N,).

    Packages do not tell how much each pair moved their answer; all of these end with least squares
    of equal weights, or close to it.
    """
    fitted = pairs[inlier]
    if len(fitted) < 2:
        reason = f"{len(fitted)} correspondences support the motion found, at least 2 are needed"
        return undetermined(reason, len(pairs), started_s)
    reason = why_one_place(fitted)
    if reason:
        return undetermined(reason, len(pairs), started_s)
    return finish(fitted, least_squares_gain(T_a_b, fitted.p_b), T_a_b, inlier, started_s)
