"""Whether a window shows one plane: a score test of its disparity for steps, creases and bends.

Where a window shows two surfaces the plane that fits best lies between them, in every picture
again: many observations do not average that out. Under the plane d + a x + b y residuals are noise;
where the disparity has further terms, each leaves its derivative times the slope g of the grey
levels. The score test (Rao 1948; Breusch and Pagan 1980) asks for all of them without a second fit.
"""

from collections.abc import Iterator

import numpy as np

from mapfusion.kernels import kernel_part
from mapfusion.se2 import Float
from mapfusion.symmetric import cholesky, solve_lower
from mapfusion.vision.window_moments import GG, GL, GR, LL, LR, ONE, G, L, Moment, R, moment

# Disparities g x^p sgn(x)^s y^q sgn(y)^t as (p, s, q, t): the plane, then what no plane has,
# steps at the window's centre, creases there, and bends.
_PLANE = ((0, 0, 0, 0), (1, 0, 0, 0), (0, 0, 1, 0))
_FURTHER = (
    *((0, 1, 0, 0), (0, 0, 0, 1)),
    *((1, 1, 0, 0), (0, 0, 1, 1)),
    *((2, 0, 0, 0), (1, 0, 1, 0), (0, 0, 2, 0)),
)
_TERMS = _PLANE + _FURTHER
_BRIGHTNESS = 2  # columns: offset and gain of one picture against the other
_KNOWN = _BRIGHTNESS + len(_PLANE)
COLUMNS = _BRIGHTNESS + len(_TERMS)
FURTHER_TERMS = len(_FURTHER)
# Share of each term's square that stands against it: terms that the texture does not tell from
# others then count nothing.
_RIDGE = 1e-6


def _asked() -> Iterator[Moment]:
    """Sums that fill in the normal matrix, its lower half row by row, and then the right side."""
    yield from (moment(ONE), moment(L), moment(LL))
    for n, term in enumerate(_TERMS):
        yield from (moment(G, *term), moment(GL, *term))
        for other in _TERMS[: n + 1]:  # of a product powers and signs add up
            yield moment(GG, *(a + b for a, b in zip(term, other, strict=True)))
    yield from (moment(R), moment(LR))
    yield from (moment(GR, *term) for term in _TERMS)


ASKED = tuple(_asked())


@kernel_part
def score(sums: Float, place: np.ndarray, normal: Float, right: Float) -> float:
    """What a window holds against one plane.

    Args:
        sums: over its pixels.
        place: among them of those that are `ASKED` for.
        normal: (COLUMNS, COLUMNS), on the way.
        right: (COLUMNS,), likewise.

    Returns:
        r^T P K (K^T P K)^-1 K^T P r in squared grey levels, K the further terms and P the
        projection that takes out brightness and plane: of white noise in r its variance times a
        chi-square variable of `FURTHER_TERMS` degrees of freedom.
    """
    k = 0
    for i in range(COLUMNS):
        for j in range(i + 1):
            normal[i, j] = sums[place[k]]
            k += 1
        normal[i, i] = normal[i, i] * (1 + _RIDGE) + _RIDGE
    for i in range(COLUMNS):
        right[i] = sums[place[k + i]]
    against = 0.0
    if cholesky(normal, 0.0):
        solve_lower(normal, right)
        for i in range(_KNOWN, COLUMNS):
            against += right[i] ** 2
    return against
