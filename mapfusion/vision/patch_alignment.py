"""Image alignment of a patch by least squares: where a point of one image lies in a later one.

All that a fit (`patch_fit.py`) needs of the earlier picture is here, so it is made once a track and
not once a view: grey levels, their slopes, and the Cholesky factor of the normal matrix.

A corner is found anew in each picture, and nearer to the wall another place of it is the corner.
The surroundings of a point of a wall change by a homography from view to view, and by gain and
offset in brightness. Around the point, x from it in the earlier picture, it is

    u(x) = place + A x / (1 + h'x)      (Hartley and Zisserman 2004, section 13.1)

and h follows from disparities: what a camera comes nearer to grows, and grows more at its nearer
side. With h left out (Shi and Tomasi 1994) the place moves by half the second derivative, averaged
over the window: little, but on walls along the way always towards the robot. The six parameters of
place and A and the two of brightness are least squares on the grey levels, Gauss-Newton with the
earlier picture's derivatives, so that the normal matrix is built once (inverse composition, Baker
and Matthews 2004).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mapfusion.geometry.numerics import Float, cholesky, kernel, solve_lower, solve_upper

# A smaller window tells scale from shift less well, a larger one is less a plane.
WINDOW_HALF_PX = 10
_SIDE_PX = 2 * WINDOW_HALF_PX + 1
_WINDOW_SIGMA_PX = 6.0  # of the Gaussian by which its pixels count
_SINGULAR = 1e-9  # pivot, as a share of its diagonal element, that is rounding error
N_PARAMETERS = 8  # shift u and v, their derivatives by u and v, offset and gain in brightness
LEVEL, SLOPE_U, SLOPE_V = range(3)  # of a window's pixels
NO_FIT = -1.0  # tolerated of a window that leaves its patch, or that has too little texture


@dataclass
class Templates:
    """Windows around points of earlier pictures: K rows, of which some are in use.

    Attributes:
        window: (K, 3, W * W) grey levels, row by row, and their slopes along u and v.
        factor: (K, 8, 8) of the normal matrix, its lower half.
        tolerated: (K,) weighted sum of squared residuals that still is the same, or NO_FIT.
    """

    window: Float
    factor: Float
    tolerated: Float

    @classmethod
    def room(cls, n: int) -> "Templates":
        """For n of them, not filled in."""
        factor = np.empty((n, N_PARAMETERS, N_PARAMETERS))
        return cls(np.empty((n, 3, _SIDE_PX**2)), factor, np.empty(n))

    @classmethod
    def of(cls, patch: np.ndarray, point: Float, noise: float, max_misfit: float) -> "Templates":
        """Those of N points, in their order; arguments as `fill` has them."""
        made = cls.room(len(patch))
        made.fill(np.arange(len(patch)), patch, point, noise, max_misfit)
        return made

    def unused(self, used: np.ndarray, n: int) -> np.ndarray:
        """Rows (n,) beside those in use (U,); there will be twice the room where that is short."""
        if len(used) + n > len(self.tolerated):
            larger = Templates.room(2 * (len(used) + n))
            for name, values in vars(self).items():
                getattr(larger, name)[: len(values)] = values
            self.window, self.factor, self.tolerated = vars(larger).values()
        is_free = np.ones(len(self.tolerated), dtype=bool)
        is_free[used] = False
        return np.flatnonzero(is_free)[:n]

    def fill(
        self, rows: np.ndarray, patch: np.ndarray, point: Float, noise: float, max_misfit: float
    ) -> None:
        """Put what points look like into some rows.

        Args:
            rows: (N,).
            patch: (N, P, P) uint8 of pictures.
            point: (N, 2) in them, u and v from their middles.
            noise: standard deviation of one picture's grey levels.
            max_misfit: what is found may differ by noise and by what this error of its place would
                explain, pixels.
        """
        given = (patch, point, 2 * noise**2, max_misfit**2, rows)
        _prepare(*given, self.window, self.factor, self.tolerated)


def _weights() -> Float:
    x = range(-WINDOW_HALF_PX, WINDOW_HALF_PX + 1)
    by_distance = np.array([math.exp(-(k * k) / (2 * _WINDOW_SIGMA_PX**2)) for k in x])
    return by_distance * by_distance[:, None]


WEIGHT = _weights().ravel()  # (W * W,), what the window's pixels count
WEIGHT.setflags(write=False)

# Sums of one product down a window's columns have whole vectors of room, and lie as far from those
# of the next as is known when loops over them are compiled.
WIDE = 24
_AT = tuple(np.uintp(k * WIDE) for k in range(20))
# Derivatives by the parameters: a factor, and what of x and y it goes with. Where the products of
# two factors begin among the sums; those with higher powers of y follow.
_DERIVATIVES = ("u", "v", "ux", "uy", "vx", "vy", "1", "L")
_PRODUCTS = {"uu": 0, "uv": 3, "vv": 6, "1u": 9, "1v": 11, "Lu": 13, "Lv": 15}
_PRODUCTS |= {"11": 17, "1L": 18, "LL": 19}


def _entries() -> Iterator[tuple[int, int, int, int]]:
    """Of the normal matrix' lower half: row, column, place of its sums, and the power of x."""
    for i, one in enumerate(_DERIVATIVES):
        for j, other in enumerate(_DERIVATIVES[: i + 1]):
            both = one + other
            place = _PRODUCTS["".join(sorted(one[0] + other[0]))] + both.count("y")
            yield i, j, place, both.count("x")


_ENTRIES = np.array([*_entries()])
_X_POWERS = np.vander(np.arange(-WINDOW_HALF_PX, WINDOW_HALF_PX + 1.0), 3, increasing=True).T.copy()


@kernel
def _prepare(
    patch: np.ndarray,
    point: Float,
    variance: float,
    square_misfit: float,
    rows: np.ndarray,
    window: Float,
    factor: Float,
    tolerated: Float,
) -> None:
    shown, down = np.empty((_SIDE_PX + 2) ** 2), np.empty(len(_AT) * WIDE)
    for n in range(len(rows)):
        i = rows[n]
        tolerated[i] = NO_FIT
        middle, reach = patch.shape[1] // 2, max(abs(point[n, 0]), abs(point[n, 1]))
        if reach + WINDOW_HALF_PX + 2 > middle:
            continue
        # Fill in grey levels between pixels, bilinear, of a window around (u, v) and one pixel
        # more. All have the same shares of the pixels around them, since u and v have no more
        # digits than their sums with whole numbers.
        u = middle + point[n, 0]
        v = middle + point[n, 1]
        half, side = WINDOW_HALF_PX + 1, _SIDE_PX + 2
        leftmost, j = np.uintp(int(u) - half), np.uintp(int(v) - half)
        a, b = u - int(u), v - int(v)
        for y in range(side):
            row, below = j + np.uintp(y), j + np.uintp(y + 1)
            for x in range(side):
                k, after = leftmost + np.uintp(x), leftmost + np.uintp(x + 1)
                upper = (1 - a) * patch[n, row, k] + a * patch[n, row, after]
                lower = (1 - a) * patch[n, below, k] + a * patch[n, below, after]
                shown[np.uintp(y * side + x)] = (1 - b) * upper + b * lower
        # Fill in window n's grey levels and their slopes from those of a grid around it.
        wide = np.uintp(_SIDE_PX + 2)
        one = np.uintp(1)
        for y in range(_SIDE_PX):
            for x in range(_SIDE_PX):
                k, at = np.uintp(y * _SIDE_PX + x), np.uintp(y + 1) * wide + np.uintp(x + 1)
                window[i, LEVEL, k] = shown[at]
                window[i, SLOPE_U, k] = 0.5 * (shown[at + one] - shown[at - one])
                window[i, SLOPE_V, k] = 0.5 * (shown[at + wide] - shown[at - wide])
        # Fill in the lower half of the normal matrix, and find the tolerated sum of squared
        # residuals: an error e of the place along some direction changes a grey level by g e, g its
        # slope along it, whose square is a mean over directions. Sums are taken down the columns
        # first, into `down`: so loops run in vectors.
        for k in range(len(down)):
            down[k] = 0.0
        for row in range(_SIDE_PX):
            y, at = float(row - WINDOW_HALF_PX), np.uintp(row * _SIDE_PX)
            yy = y * y
            for x in range(_SIDE_PX):
                m, k = np.uintp(x), at + np.uintp(x)
                u, v, level = window[i, SLOPE_U, k], window[i, SLOPE_V, k], window[i, LEVEL, k]
                w = WEIGHT[k]
                wu, wv, w_level = w * u, w * v, w * level
                uu, uv, vv, u_level, v_level = wu * u, wu * v, wv * v, wu * level, wv * level
                down[m] += uu
                down[m + _AT[1]] += uu * y
                down[m + _AT[2]] += uu * yy
                down[m + _AT[3]] += uv
                down[m + _AT[4]] += uv * y
                down[m + _AT[5]] += uv * yy
                down[m + _AT[6]] += vv
                down[m + _AT[7]] += vv * y
                down[m + _AT[8]] += vv * yy
                down[m + _AT[9]] += wu
                down[m + _AT[10]] += wu * y
                down[m + _AT[11]] += wv
                down[m + _AT[12]] += wv * y
                down[m + _AT[13]] += u_level
                down[m + _AT[14]] += u_level * y
                down[m + _AT[15]] += v_level
                down[m + _AT[16]] += v_level * y
                down[m + _AT[17]] += w
                down[m + _AT[18]] += w_level
                down[m + _AT[19]] += w_level * level
        for e in range(len(_ENTRIES)):
            first, power, total = np.uintp(_ENTRIES[e, 2]) * np.uintp(WIDE), _ENTRIES[e, 3], 0.0
            for x in range(_SIDE_PX):
                total += down[first + np.uintp(x)] * _X_POWERS[power, x]
            factor[i, _ENTRIES[e, 0], _ENTRIES[e, 1]] = total
        square_slopes = factor[i, 0, 0] + factor[i, 1, 1]
        sum_of_squares = variance * factor[i, 6, 6] + 0.5 * square_misfit * square_slopes
        if cholesky(factor[i], _SINGULAR):
            tolerated[i] = sum_of_squares


_MAX_STEPS = 15
_CONVERGED_PX = 0.005  # far below what noise lets one measure
# Where a window's far side would shrink to a half, it is no piece of a wall that one looks at.
_LEAST_SCALE = 0.5
_ONE = np.uintp(1)  # indices without a sign, which a kernel need not wrap around

_PIXEL_AT = tuple(np.uintp(k * WIDE) for k in range(7))  # where sums of each product begin
_BYTE, _HALF, _LOW = np.uint32(8), np.uint32(16), np.uint32(0xFF)


def fit_patches(
    templates: Templates, rows: np.ndarray, after: np.ndarray, warp: Float, bend: Float
) -> np.ndarray:
    """Move each `warp` to the map from around a point to a patch of a later picture.

    Args:
        templates: how points looked.
        rows: (N,) which of them.
        after: (N, P, P) uint8 of the later picture.
        warp: (N, 2, 3), right to a few pixels; columns are d(u, v)/du, d(u, v)/dv, and where the
            point lies from the middle of `after`.
        bend: (N, 2) h, per pixel.

    Returns:
        (N,) bool: False where the window leaves a patch, has too little texture, or does not fit.
    """
    given = (templates.window, templates.factor, templates.tolerated, rows, after, warp, bend)
    found, area = np.zeros(len(rows), dtype=np.bool_), len(WEIGHT)
    cell, share, residual = np.empty(area, np.uint32), np.empty((2, area)), np.empty(area)
    _fit_all(*given, cell, share, residual, np.empty(len(_PIXEL_AT) * WIDE), found)
    return found


@kernel
def _fit_all(
    window: Float,
    factor: Float,
    tolerated: Float,
    rows: np.ndarray,
    after: np.ndarray,
    warp: Float,
    bend: Float,
    cell: np.ndarray,
    share: Float,
    residual: Float,
    down: Float,
    found: np.ndarray,
) -> None:
    """Move warps and mark what is found; from `cell` to `down` it is room on the way."""
    for n in range(len(rows)):
        i = rows[n]
        if tolerated[i] >= 0:
            square = _settle(
                window, i, factor[i], after, n, warp, bend, cell, share, residual, down
            )
            found[n] = 0 <= square <= tolerated[i]


@kernel
def _settle(
    window: Float,
    i: int,
    factor: Float,
    after: np.ndarray,
    n: int,
    warp: Float,
    bend: Float,
    cell: np.ndarray,
    share: Float,
    residual: Float,
    down: Float,
) -> float:
    """Move warp n until it stays; the weighted sum of squared residuals, negative if it does not.

    `cell`, `share`, `residual` and `down` are room for what is needed on the way.
    """
    step = np.empty(N_PARAMETERS)
    for _ in range(_MAX_STEPS):
        if not _stays_inside(after.shape[1] // 2, warp, bend, n):
            return -1.0
        _find_places(after.shape[1], warp, bend, n, cell, share)
        # Replace pixels by the grey levels there, to the right and below, the bytes of one
        # number.
        side = np.uintp(after.shape[2])
        patch = after[n].ravel()
        for k in range(len(cell)):
            at = np.uintp(cell[k])
            upper = np.uint32(patch[at]) | np.uint32(patch[at + _ONE]) << _BYTE
            lower = np.uint32(patch[at + side]) | np.uint32(patch[at + side + _ONE]) << _BYTE
            cell[k] = upper | lower << _HALF
        # Fill in after - before; between pixels grey levels are bilinear.
        for k in range(len(cell)):
            a, b, levels = share[0, k], share[1, k], cell[k]
            p, q = float(levels & _LOW), float((levels >> _BYTE) & _LOW)
            r, s = float((levels >> _HALF) & _LOW), float(levels >> (_HALF + _BYTE))
            upper, lower = (1 - a) * p + a * q, (1 - a) * r + a * s
            residual[k] = (1 - b) * upper + b * lower - window[i, LEVEL, k]
        # Sum weighted squared residuals, and J^T W r into `step`.
        # Sums are taken down the columns first, into `down`: so loops run in vectors.
        for k in range(len(down)):
            down[k] = 0.0
        for row in range(_SIDE_PX):
            y, at = float(row - WINDOW_HALF_PX), np.uintp(row * _SIDE_PX)
            for x in range(_SIDE_PX):
                m, k = np.uintp(x), at + np.uintp(x)
                gu, gv, off = window[i, SLOPE_U, k], window[i, SLOPE_V, k], residual[k]
                weighted = WEIGHT[k] * off
                along_u, along_v = weighted * gu, weighted * gv
                down[m] += weighted * off
                down[m + _PIXEL_AT[1]] += along_u
                down[m + _PIXEL_AT[2]] += along_v
                down[m + _PIXEL_AT[3]] += along_u * y
                down[m + _PIXEL_AT[4]] += along_v * y
                down[m + _PIXEL_AT[5]] += weighted
                down[m + _PIXEL_AT[6]] += weighted * window[i, LEVEL, k]
        square = m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = 0.0
        for k in range(_SIDE_PX):
            m, x = np.uintp(k), float(k - WINDOW_HALF_PX)
            along_u, along_v = down[m + _PIXEL_AT[1]], down[m + _PIXEL_AT[2]]
            square, m0, m1 = square + down[m], m0 + along_u, m1 + along_v
            m2, m3 = m2 + along_u * x, m3 + down[m + _PIXEL_AT[3]]
            m4, m5 = m4 + along_v * x, m5 + down[m + _PIXEL_AT[4]]
            m6, m7 = m6 + down[m + _PIXEL_AT[5]], m7 + down[m + _PIXEL_AT[6]]
        step[0], step[1], step[2], step[3] = m0, m1, m2, m3
        step[4], step[5], step[6], step[7] = m4, m5, m6, m7
        solve_lower(factor, step)
        for k in range(N_PARAMETERS):
            square -= step[k] ** 2  # what the step explains: all of gain and offset
        solve_upper(factor, step)
        # Warp after the inverse of the step's own, which moved the earlier picture.
        # To first order in h: steps go to zero, and with them what that leaves out.
        own = warp[n]
        a, b, c, d = 1 + step[2], step[3], step[4], 1 + step[5]
        determinant = a * d - b * c
        for r in range(2):
            first, second = own[r, 0], own[r, 1]
            own[r, 0] = (first * d - second * c) / determinant
            own[r, 1] = (second * a - first * b) / determinant
            own[r, 2] -= own[r, 0] * step[0] + own[r, 1] * step[1]
        if abs(step[0]) < _CONVERGED_PX and abs(step[1]) < _CONVERGED_PX:
            return max(square, 0.0)
    return -1.0


@kernel
def _stays_inside(middle: int, warp: Float, bend: Float, n: int) -> bool:
    """Whether all of a window lies on a patch."""
    least = 1.0 - (abs(bend[n, 0]) + abs(bend[n, 1])) * WINDOW_HALF_PX
    if not least > _LEAST_SCALE:
        return False
    for r in range(2):
        across = (abs(warp[n, r, 0]) + abs(warp[n, r, 1])) * WINDOW_HALF_PX
        if not across / least + abs(warp[n, r, 2]) + 1 <= middle:
            return False
    return True


@kernel(error_model="numpy")  # to ask whether it divides by zero takes longer than that
def _find_places(
    side: int, warp: Float, bend: Float, n: int, cell: np.ndarray, share: Float
) -> None:
    """Which pixel of a patch is before each of the window's, and shares of the way to the next."""
    half, middle, h_u, h_v = WINDOW_HALF_PX, side // 2, bend[n, 0], bend[n, 1]
    uu, uv, u_0 = warp[n, 0, 0], warp[n, 0, 1], warp[n, 0, 2]
    vu, vv, v_0 = warp[n, 1, 0], warp[n, 1, 1], warp[n, 1, 2]
    for y in range(-half, half + 1):
        first = np.uintp((y + half) * (2 * half + 1))
        for k in range(2 * half + 1):
            x = k - half
            scale = 1.0 / (1.0 + h_u * x + h_v * y)
            at_u = middle + u_0 + scale * (uu * x + uv * y)
            at_v = middle + v_0 + scale * (vu * x + vv * y)
            column, row = np.int32(at_u), np.int32(at_v)
            cell[first + np.uintp(k)] = row * np.int32(side) + column
            share[0, first + np.uintp(k)] = at_u - float(column)
            share[1, first + np.uintp(k)] = at_v - float(row)
