"""Tests of a stereo window: does it show one plane, or the edge of an object?

They are taken in two steps: down the columns, with powers of y, apart above the middle row, in it
and below; then along x. Only the first goes over all pixels, in the processor's vectors.

Where a window shows two surfaces the plane that fits best lies between them, in every picture
again: many observations do not average that out. Under the plane d + a x + b y residuals are noise;
where the disparity has further terms, each leaves its derivative times the slope g of the grey
levels. The score test (Rao 1948; Breusch and Pagan 1980) asks for all of them without a second fit.

Where two surfaces meet in the image and nothing in the world, one half is not on the plane.

These are sums over their pixels, which the silhouette's test (`silhouette_test.py`) and the test
for one plane (`plane_test.py`) ask for.
"""

from collections.abc import Iterator
from functools import cache

import numpy as np

from mapfusion.geometry.numerics import Float, cholesky, kernel, solve_lower
from mapfusion.vision.subpixel import (
    DOWN,
    FIELDS,
    LEVEL,
    RESIDUAL,
    ROOM,
    SLOPE,
    WIDE,
    fill_down,
    fill_left,
    fill_residuals,
    parts_inside,
)

# Products that are summed down the columns: with L the grey levels of the left picture, g and h
# their slopes along u and v, r = right - left. Those of g also times y and its square, g^2 times
# all powers up to the fourth.
GG, G, GL, GR = 0, 5, 8, 11
L, LL, R, LR, HH, RR, ONE = range(14, 21)
N_PRODUCTS = 21
# How the rows above the middle, in it and below count, and likewise columns: all, by their sign and
# by its square; what is above (or to the left) alone, and what is below.
SIDES = np.array([[1, 1, 1], [-1, 0, 1], [1, 0, 1], [1, 0, 0], [0, 0, 1]], dtype=np.float64)
ALL = 0
ABOVE = LEFT = 3
BELOW = RIGHT = 4
_SQUARED = 2  # place in it of the signs squared
_POWERS = 5  # from 0 on

Moment = tuple[int, int, int]  # a product times a power of y, how rows count, how columns do


def moment(product: int, p: int = 0, s: int = ALL, q: int = 0, t: int = ALL) -> Moment:
    """The sum of a product times x^p y^q, where columns count as `SIDES` s and rows as t."""
    # what has the sign's square as well as a power loses nothing without it
    s, t = (ALL if power and side == _SQUARED else side for power, side in ((p, s), (q, t)))
    return product + q, t, s * _POWERS + p


@cache
def column_weights(half: int) -> Float:
    """How the columns of a window count (S, 2 half + 1), by the last number of a moment."""
    x = np.arange(-half, half + 1)
    powers = np.vander(x.astype(np.float64), _POWERS, increasing=True).T
    weights = (SIDES[:, None, np.sign(x) + 1] * powers).reshape(-1, len(x))
    weights.setflags(write=False)
    return weights


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


PLANE_MOMENTS = tuple(_asked())


@kernel
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


_OF_A_HALF = (ONE, R, RR, GG, HH)
_EACH = len(_OF_A_HALF)
# How columns and rows of the left half, the right, the upper and the lower one count.
_HALVES = ((LEFT, ALL), (RIGHT, ALL), (ALL, ABOVE), (ALL, BELOW))
SILHOUETTE_MOMENTS = tuple(moment(product, s=s, t=t) for s, t in _HALVES for product in _OF_A_HALF)


def fails_silhouette_test(
    squares: Float, noise: float, max_misfit: float, max_rows: float
) -> np.ndarray:
    """Whether any half (left, right, upper, lower) of each window does not fit the plane (N,) bool.

    An error e in disparity changes the grey level by g e, g its slope along u, and rows that are
    off by f change it by h f, h its slope along v. So a half fits when
    sum r^2 <= n 2 noise^2 + max_misfit^2 sum g^2 + max_rows^2 sum h^2.

    Args:
        squares: (N, 4, 4) from `window_sums`.
        noise: standard deviation of one image's grey levels.
        max_misfit: e, pixels.
        max_rows: f, pixels.
    """
    tolerated = squares[..., [0, 2, 3]] @ [2 * noise**2, max_misfit**2, max_rows**2]
    return np.any(squares[..., 1] > tolerated, axis=1)


@kernel
def fill_in_halves(sums: Float, place: np.ndarray, squares: Float, n: int) -> None:
    """Fill in the halves (4, 4) of window n, see `window_sums`; residuals less their own mean.

    `place` is that of the sums that are `ASKED` for.
    """
    first, second = 2 * _EACH, 3 * _EACH  # the upper half and the lower one
    count = sums[place[first]] + sums[place[second]]
    off = sums[place[first + 1]] + sums[place[second + 1]]
    offset = off / count if count > 0 else 0.0  # in brightness
    for k in range(4):
        at = k * _EACH
        pixels, residuals, square = sums[place[at]], sums[place[at + 1]], sums[place[at + 2]]
        squares[n, k, 0] = pixels
        squares[n, k, 1] = square + pixels * offset**2 - 2 * offset * residuals
        squares[n, k, 2], squares[n, k, 3] = sums[place[at + 3]], sums[place[at + 4]]


_ASKED = (PLANE_MOMENTS, SILHOUETTE_MOMENTS, (moment(ONE), moment(GG), moment(HH)))
# Each sum is taken once, and so are those down the columns that several go on from.
_SUMS, _place = np.unique([m for asked in _ASKED for m in asked], axis=0, return_inverse=True)
_DOWN_SUMS, _FROM = np.unique(_SUMS[:, :2], axis=0, return_inverse=True)
_OF_PLANE, _OF_HALVES, _OF_SLOPES = np.split(_place, np.cumsum([len(a) for a in _ASKED[:-1]]))
# Where sums of each product begin, and those of the rows of the next part.
_AT = tuple(np.uintp(k) * WIDE for k in range(N_PRODUCTS))
_PART = np.uintp(N_PRODUCTS) * WIDE
_INSIDE = FIELDS  # of a window's pixels, after its other fields: 1 in both pictures, else 0


def window_statistics(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    plane: Float,
    silhouette_half: int,
    plane_half: int,
) -> tuple[Float, Float]:
    """What the two tests look at.

    Args:
        left: (H, W) uint8.
        right: (H, W) uint8.
        pixel: (N, 2) int64 centres of the windows; what leaves an image is not looked at.
        plane: (N, 3) from `fit_planes`.
        silhouette_half: half side of the window of the silhouette test, `MOST_HALF_PX` at most.
        plane_half: half side of the window of the test for one plane, likewise.

    Returns:
        Of each half (left, right, upper, lower) of each window (N, 4, 4) the number of pixels, and
        the sums of squared residuals without the window's offset in brightness, of squared slopes
        of the grey levels along u and along v. Then (N, 3): the score of the test for one plane,
        see there, and the mean squared slopes along u and along v.
    """
    squares, scores = np.empty((len(pixel), 4, 4)), np.empty((len(pixel), 3))
    weight = column_weights(max(silhouette_half, plane_half))
    _look_at_all(left, right, pixel, plane, silhouette_half, plane_half, weight, squares, scores)
    return squares, scores


@kernel
def _look_at_all(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    plane: Float,
    silhouette_half: int,
    plane_half: int,
    weight: Float,
    squares: Float,
    scores: Float,
) -> None:
    half = max(silhouette_half, plane_half)
    area = (2 * half + 1) ** 2
    window, share = np.empty((FIELDS + 1, area)), np.empty(area)
    room, down = np.empty((ROOM, area), np.uint32), np.empty(3 * N_PRODUCTS * WIDE)
    column, sums = np.empty(2 * half + 1), np.empty(len(_SUMS))
    normal, moments = np.empty((COLUMNS, COLUMNS)), np.empty(COLUMNS)
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        fill_left(left, u, v, half, window)
        fill_down(left, u, v, half, window)
        fill_residuals(right, u, v, half, plane, n, window, room, share)
        shade = float(left[v, u])  # grey levels are counted from it: small numbers lose less
        # Mark which pixels of a window lie in both pictures, and let the others add nothing.
        top, bottom, left_end, right_end = parts_inside(right, u, v, half)
        d, a, b = plane[n, 0], plane[n, 1], plane[n, 2]
        for k in range(window.shape[1]):
            window[_INSIDE, k] = 1.0
        for y in range(-half, half + 1):
            first, last, start = left_end, right_end, u - d - b * y
            if not top <= y <= bottom:
                last = first - 1
            while first <= last and not 1 <= start + first - a * first < right.shape[1] - 2:
                first += 1
            while first <= last and not 1 <= start + last - a * last < right.shape[1] - 2:
                last -= 1
            if first == -half and last == half:
                continue
            middle = (y + half) * (2 * half + 1) + half
            for x in range(-half, half + 1):
                if not first <= x <= last:
                    window[LEVEL, middle + x] = shade
                    window[SLOPE, middle + x] = window[DOWN, middle + x] = 0.0
                    window[RESIDUAL, middle + x] = window[_INSIDE, middle + x] = 0.0
        for own in (plane_half, silhouette_half):
            # Sums down the columns of a window that are up to `own` from its middle, as far up
            # and down.
            for k in range(3 * N_PRODUCTS):
                first = np.uintp(k) * WIDE
                for i in range(2 * own + 1):
                    down[first + np.uintp(i)] = 0.0
            for y in range(-own, own + 1):
                part = np.uintp((1 + (y > 0) - (y < 0)) * N_PRODUCTS) * WIDE
                at, q = np.uintp((y + half) * (2 * half + 1) + half - own), float(y)
                for i in range(2 * own + 1):
                    m, k = part + np.uintp(i), at + np.uintp(i)
                    L, g, h = window[LEVEL, k] - shade, window[SLOPE, k], window[DOWN, k]
                    r, gy = window[RESIDUAL, k], g * q
                    gyy = gy * q
                    down[m] += g * g
                    down[m + _AT[1]] += g * gy
                    down[m + _AT[2]] += gy * gy
                    down[m + _AT[3]] += gy * gyy
                    down[m + _AT[4]] += gyy * gyy
                    down[m + _AT[5]] += g
                    down[m + _AT[6]] += gy
                    down[m + _AT[7]] += gyy
                    down[m + _AT[8]] += g * L
                    down[m + _AT[9]] += gy * L
                    down[m + _AT[10]] += gyy * L
                    down[m + _AT[11]] += g * r
                    down[m + _AT[12]] += gy * r
                    down[m + _AT[13]] += gyy * r
                    down[m + _AT[14]] += L
                    down[m + _AT[15]] += L * L
                    down[m + _AT[16]] += r
                    down[m + _AT[17]] += L * r
                    down[m + _AT[18]] += h * h
                    down[m + _AT[19]] += r * r
                    down[m + _AT[20]] += window[_INSIDE, k]
            # Fill in what is asked for from sums down the columns; `column` is room for those of
            # a row.
            last = -1
            for e in range(len(_SUMS)):
                if _FROM[e] != last:
                    last = _FROM[e]
                    product, t = np.uintp(_DOWN_SUMS[last, 0]), _DOWN_SUMS[last, 1]
                    above, at, below = SIDES[t, 0], SIDES[t, 1], SIDES[t, 2]
                    m = product * WIDE
                    for i in range(2 * own + 1):
                        k = m + np.uintp(i)
                        column[i] = (
                            above * down[k] + at * down[k + _PART] + below * down[k + _PART + _PART]
                        )
                w, total = _SUMS[e, 2], 0.0
                for i in range(2 * own + 1):
                    total += column[i] * weight[w, np.uintp(half - own + i)]
                sums[e] = total
            if own == plane_half:
                pixels = max(sums[_OF_SLOPES[0]], 1.0)
                scores[n, 0] = score(sums, _OF_PLANE, normal, moments)
                scores[n, 1] = sums[_OF_SLOPES[1]] / pixels
                scores[n, 2] = sums[_OF_SLOPES[2]] / pixels
            if own == silhouette_half:
                fill_in_halves(sums, _OF_HALVES, squares, n)
                break
