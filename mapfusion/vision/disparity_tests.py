"""Plane test and silhouette test of stereo windows.

Plane test: if a window shows two surfaces, the fitted plane lies between them in every image, and
averaging over images does not remove the error. Under the plane d + a x + b y the residuals are
noise. A further term of the disparity adds its derivative times the slope g of the grey levels. The
score test (Rao 1948; Breusch and Pagan 1980) tests all further terms without a second fit.

Silhouette test: where two surfaces meet in the image but not in the world, one half of the window
does not agree with the plane.

Both tests need moments: sums over a window's pixels of products with powers of x and y. The sums
are computed in two steps. The first step sums columns, with powers of y, separately above, in and
below the middle row; it is vectorised over all pixels. The second step sums the columns with powers
of x.
"""

import numpy as np

from mapfusion.geometry.numerics import Float, cholesky, kernel, solve_lower
from mapfusion.vision.subpixel import (
    DOWN,
    FIELDS,
    LEVEL,
    LEVEL_FIELDS,
    RESIDUAL,
    SLOPE,
    WIDE,
    fill_down,
    fill_left,
    fill_residuals,
    parts_inside,
)

# Products that are summed down the columns: L are the grey levels of the left image, g and h their
# slopes along u and v, and r = right - left. Products with g are also summed times y and y^2, g^2
# times all powers of y up to the fourth.
GG, G, GL, GR = 0, 5, 8, 11
L, LL, R, LR, HH, RR, ONE = range(14, 21)
N_PRODUCTS = 21
# Weights of the rows above, in and below the middle row, and likewise of the columns: all rows, the
# sign of y, its square, the upper rows, the lower rows.
SIDES = np.array([[1, 1, 1], [-1, 0, 1], [1, 0, 1], [1, 0, 0], [0, 0, 1]], dtype=np.float64)
ALL = 0
ABOVE = LEFT = 3
BELOW = RIGHT = 4
_SQUARED = 2  # index of the squared sign
_POWERS = 5  # powers 0 to 4

Moment = tuple[int, int, int]  # product times a power of y, row of SIDES, column of the weights


def moment(product: int, p: int = 0, s: int = ALL, q: int = 0, t: int = ALL) -> Moment:
    """Return the key of the sum of a product times x^p y^q with column and row weights SIDES s, t.

    A squared sign beside a power has no effect and is left out.
    """
    s, t = (ALL if power and side == _SQUARED else side for power, side in ((p, s), (q, t)))
    return product + q, t, s * _POWERS + p


# Disparities x^p sgn(x)^s y^q sgn(y)^t as (p, s, q, t): the plane, then further terms: steps at the
# window's centre, creases there, and curvature.
_PLANE = ((0, 0, 0, 0), (1, 0, 0, 0), (0, 0, 1, 0))
_FURTHER = (
    *((0, 1, 0, 0), (0, 0, 0, 1)),
    *((1, 1, 0, 0), (0, 0, 1, 1)),
    *((2, 0, 0, 0), (1, 0, 1, 0), (0, 0, 2, 0)),
)
_TERMS = _PLANE + _FURTHER
_BRIGHTNESS = 2  # columns: offset and gain between the images
_KNOWN = _BRIGHTNESS + len(_PLANE)
COLUMNS = _BRIGHTNESS + len(_TERMS)
FURTHER_TERMS = len(_FURTHER)
# Ridge, as a share of each diagonal entry: terms that the texture does not observe then have no
# effect.
_RIDGE = 1e-6

# Lower half of the normal matrix, row by row: two rows of brightness, then the disparity terms. The
# powers and signs of two terms add up in their product. Then the right-hand side.
PLANE_MOMENTS: tuple[Moment, ...] = (
    moment(ONE),
    moment(L),
    moment(LL),
    *(
        entry
        for n, term in enumerate(_TERMS)
        for entry in (
            moment(G, *term),
            moment(GL, *term),
            *(
                moment(GG, *(a + b for a, b in zip(term, other, strict=True)))
                for other in _TERMS[: n + 1]
            ),
        )
    ),
    moment(R),
    moment(LR),
    *(moment(GR, *term) for term in _TERMS),
)


@kernel
def score(sums: Float, offsets: np.ndarray, normal: Float, right: Float) -> float:
    """Compute the statistic of the plane test.

    Args:
        sums: moments of a window.
        offsets: indices of `PLANE_MOMENTS` in `sums`.
        normal: work array, shape (COLUMNS, COLUMNS).
        right: work array, shape (COLUMNS,).

    Returns:
        r^T P K (K^T P K)^-1 K^T P r in squared grey levels. K are the further terms, P is the
        projection that removes brightness and plane. For white noise r the statistic is its
        variance times a chi-square variable of `FURTHER_TERMS` degrees of freedom.
    """
    k = 0
    for i in range(COLUMNS):
        for j in range(i + 1):
            normal[i, j] = sums[offsets[k]]
            k += 1
        normal[i, i] = normal[i, i] * (1 + _RIDGE) + _RIDGE
    for i in range(COLUMNS):
        right[i] = sums[offsets[k + i]]
    against = 0.0
    if cholesky(normal, 0.0):
        solve_lower(normal, right)
        for i in range(_KNOWN, COLUMNS):
            against += right[i] ** 2
    return against


_HALF_PRODUCTS = (ONE, R, RR, GG, HH)
_EACH = len(_HALF_PRODUCTS)
# Weights of columns and rows for the left, right, upper and lower half.
_HALVES = ((LEFT, ALL), (RIGHT, ALL), (ALL, ABOVE), (ALL, BELOW))
SILHOUETTE_MOMENTS = tuple(
    moment(product, s=s, t=t) for s, t in _HALVES for product in _HALF_PRODUCTS
)


def fails_silhouette_test(
    squares: Float, noise: float, max_misfit: float, max_rows: float
) -> np.ndarray:
    """Return True for each window with a half (left, right, upper, lower) beside the plane.

    A disparity error e changes the grey level by g e, g its slope along u. A row error f changes
    the grey level by h f, h its slope along v. So a half of n pixels agrees with the plane when
    sum r^2 <= n 2 noise^2 + max_misfit^2 sum g^2 + max_rows^2 sum h^2.

    Args:
        squares: sums of the halves from `window_statistics`, shape (N, 4, 4).
        noise: standard deviation of the grey levels of one image.
        max_misfit: e, pixels.
        max_rows: f, pixels.

    Returns:
        Shape (N,) bool.
    """
    tolerated = squares[..., [0, 2, 3]] @ [2 * noise**2, max_misfit**2, max_rows**2]
    return np.any(squares[..., 1] > tolerated, axis=1)


@kernel
def fill_in_halves(sums: Float, offsets: np.ndarray, squares: Float, n: int) -> None:
    """Fill in the halves of window n, see `window_statistics`; residuals without their mean.

    `offsets` are the indices of `SILHOUETTE_MOMENTS` in `sums`.
    """
    upper, lower = 2 * _EACH, 3 * _EACH
    count = sums[offsets[upper]] + sums[offsets[lower]]
    total = sums[offsets[upper + 1]] + sums[offsets[lower + 1]]
    offset = total / count if count > 0 else 0.0  # brightness offset
    for k in range(4):
        at = k * _EACH
        pixels, residuals, square = sums[offsets[at]], sums[offsets[at + 1]], sums[offsets[at + 2]]
        squares[n, k, 0] = pixels
        squares[n, k, 1] = square + pixels * offset**2 - 2 * offset * residuals
        squares[n, k, 2], squares[n, k, 3] = sums[offsets[at + 3]], sums[offsets[at + 4]]


_MOMENTS = (PLANE_MOMENTS, SILHOUETTE_MOMENTS, (moment(ONE), moment(GG), moment(HH)))
# Each moment, and each column sum behind several moments, is computed once.
_SUMS, _place = np.unique([m for own in _MOMENTS for m in own], axis=0, return_inverse=True)
_COLUMN_SUMS, _FROM = np.unique(_SUMS[:, :2], axis=0, return_inverse=True)
_OF_PLANE, _OF_HALVES, _OF_SLOPES = np.split(_place, np.cumsum([len(m) for m in _MOMENTS[:-1]]))
# Offsets of the column sums of each product, and of the next group of rows.
_AT = tuple(np.uintp(k) * WIDE for k in range(N_PRODUCTS))
_PART = np.uintp(N_PRODUCTS) * WIDE
_INSIDE = FIELDS  # further field of a window's pixels: 1 inside both images, else 0


@kernel
def window_statistics(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    plane: Float,
    silhouette_half: int,
    plane_half: int,
) -> tuple[Float, Float]:
    """Compute the statistics of both tests.

    Args:
        left: shape (H, W) uint8.
        right: shape (H, W) uint8.
        pixel: centres of the windows, shape (N, 2) int64. Pixels outside an image are left out.
        plane: planes from `fit_planes`, shape (N, 3).
        silhouette_half: half side of the window of the silhouette test, `MOST_HALF_PX` at most.
        plane_half: half side of the window of the plane test, likewise.

    Returns:
        Halves, shape (N, 4, 4): for the left, right, upper and lower half of each window the number
        of pixels, the sum of squared residuals without the window's brightness offset, and the sums
        of squared slopes of the grey levels along u and along v. Scores, shape (N, 3): the `score`
        of the plane test, and the mean squared slopes along u and along v.
    """
    squares, scores = np.empty((len(pixel), 4, 4)), np.empty((len(pixel), 3))
    half = max(silhouette_half, plane_half)
    area = (2 * half + 1) ** 2
    window, share = np.empty((FIELDS + 1, area)), np.empty(area)
    levels, down = np.empty((LEVEL_FIELDS, area), np.uint32), np.empty(3 * N_PRODUCTS * WIDE)
    column, sums = np.empty(2 * half + 1), np.empty(len(_SUMS))
    normal, moments = np.empty((COLUMNS, COLUMNS)), np.empty(COLUMNS)
    # Weights of the columns, by the index in `Moment`.
    weight = np.empty((len(SIDES) * _POWERS, 2 * half + 1))
    for x in range(-half, half + 1):
        for k in range(len(SIDES)):
            power = SIDES[k, 1 + (x > 0) - (x < 0)]
            for p in range(_POWERS):
                weight[k * _POWERS + p, x + half] = power
                power *= x
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        fill_left(left, u, v, half, window)
        fill_down(left, u, v, half, window)
        fill_residuals(right, u, v, half, plane, n, window, levels, share)
        shade = float(left[v, u])  # origin of the grey levels, against cancellation
        # Mark the pixels inside both images; set the fields of the other pixels to zero.
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
            # Column sums of the window of half side `own`.
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
            # Moments from the column sums; `column` holds the sums of one product and row weight.
            last = -1
            for e in range(len(_SUMS)):
                if _FROM[e] != last:
                    last = _FROM[e]
                    product, t = np.uintp(_COLUMN_SUMS[last, 0]), _COLUMN_SUMS[last, 1]
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
    return squares, scores
