"""For packages with the interface `align`: from a motion and its pairs to a whole answer."""

import numpy as np

from mapfusion.align.method import supported
from mapfusion.align.pairs import Pairs
from mapfusion.align.registration import alignment_of_fit
from mapfusion.align.result import Alignment
from mapfusion.se2 import Float


def supported_by(
    pairs: Pairs, inlier: np.ndarray, T_a_b: Float, started_s: float, refusal: str = ""
) -> Alignment:
    """The answer of a method whose motion is the least squares, equally weighted, of some pairs.

    `inlier` (N,) marks those it was fitted to; `started_s` is `time.perf_counter()` at the start,
    `refusal` why the estimate is not to be trusted, if so.
    """
    found = supported(pairs, inlier, T_a_b, refusal)
    return alignment_of_fit(found, pairs, np.arange(len(pairs)), started_s)
