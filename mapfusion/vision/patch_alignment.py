"""Image alignment of patches by least squares: track points of one image in a later image.

A corner detector finds another point of a wall when the camera comes nearer, so a track follows the
image around its first point instead. Between two views the image around a point of a wall changes
by a homography, and by gain and offset of the brightness. A pixel at x from the point in the
earlier image lies in the later image at

    u(x) = place + A x / (1 + h'x)      (Hartley and Zisserman 2004, section 13.1)

and h follows from the disparities. Without h (Shi and Tomasi 1994) the place has an error of half
the second derivative, averaged over the window. The error is small, but on walls along the path it
always points towards the robot.

The six parameters of place and A and the two of brightness are fitted to the grey levels by
Gauss-Newton steps with the derivatives of the earlier image (inverse composition, Baker and
Matthews 2004). So a template with grey levels, their slopes and the Cholesky factor of the normal
matrix is computed once per track.
"""

import math
from dataclasses import dataclass

import numpy as np

from mapfusion.geometry.numerics import Float, cholesky, kernel, solve_lower, solve_upper

# Half side of the window: in a smaller window scale and shift are correlated, a larger window is
# less planar.
WINDOW_HALF_PX = 10
_SIDE_PX = 2 * WINDOW_HALF_PX + 1
_WINDOW_SIGMA_PX = 6.0  # standard deviation of the Gaussian weight of the pixels
_SINGULAR = 1e-9  # largest pivot by rounding errors, as a share of its diagonal entry
N_PARAMETERS = 8  # shift u and v, their derivatives by u and v, brightness offset and gain
LEVEL, SLOPE_U, SLOPE_V = range(3)  # fields of a window's pixels
NO_FIT = -1.0  # `tolerated` of a window that leaves its patch or has too little texture


@dataclass
class Templates:
    """Windows around points of earlier images: K rows, some of them in use.

    Attributes:
        window: grey levels, row by row, and their slopes along u and v, shape (K, 3, W * W).
        factor: lower Cholesky factors of the normal matrices, shape (K, 8, 8).
        tolerated: largest weighted sum of squared residuals of a fit, or NO_FIT, shape (K,).
        noise_grey: standard deviation of the grey levels of one image.
        max_misfit_px: error of the place that a fit tolerates besides noise.
    """

    window: Float
    factor: Float
    tolerated: Float
    noise_grey: float
    max_misfit_px: float

    @classmethod
    def allocate(cls, n: int, noise_grey: float, max_misfit_px: float) -> "Templates":
        """Allocate n templates."""
        window = np.empty((n, 3, _SIDE_PX**2))
        factor = np.empty((n, N_PARAMETERS, N_PARAMETERS))
        return cls(window, factor, np.empty(n), noise_grey, max_misfit_px)

    @classmethod
    def of(cls, patch: np.ndarray, point: Float, noise: float, max_misfit: float) -> "Templates":
        """Make the templates of N points, in their order; `patch` and `point` as in `fill`."""
        templates = cls.allocate(len(patch), noise, max_misfit)
        templates.fill(np.arange(len(patch)), patch, point)
        return templates

    def unused(self, used: np.ndarray, n: int) -> np.ndarray:
        """Return n unused rows; `used` (U,) are in use. A short table grows to twice the need."""
        if len(used) + n > len(self.tolerated):
            larger = self.allocate(2 * (len(used) + n), self.noise_grey, self.max_misfit_px)
            for name in ("window", "factor", "tolerated"):
                values = getattr(self, name)
                getattr(larger, name)[: len(values)] = values
                setattr(self, name, getattr(larger, name))
        is_free = np.ones(len(self.tolerated), dtype=bool)
        is_free[used] = False
        return np.flatnonzero(is_free)[:n]

    def fill(self, rows: np.ndarray, patch: np.ndarray, point: Float) -> None:
        """Fill rows with the templates of points.

        Args:
            rows: shape (N,).
            patch: parts of images, shape (N, P, P) uint8.
            point: u and v of the points from the patches' middles, shape (N, 2).
        """
        given = (patch, point, 2 * self.noise_grey**2, self.max_misfit_px**2, rows)
        _fill_templates(*given, self.window, self.factor, self.tolerated)


_by_distance = np.array(
    [
        math.exp(-(k * k) / (2 * _WINDOW_SIGMA_PX**2))
        for k in range(-WINDOW_HALF_PX, WINDOW_HALF_PX + 1)
    ]
)
WEIGHT = (_by_distance * _by_distance[:, None]).ravel()  # (W * W,) weights of a window's pixels
WEIGHT.setflags(write=False)

# Length of the column sums of one product, in whole vectors. A constant length lets the compiler
# vectorise loops over several products.
WIDE = 24
_AT = tuple(np.uintp(k * WIDE) for k in range(20))
# Derivatives by the parameters: a factor (slope along u or v, one, or grey level), times x or y.
# Offsets of the products of two factors among the column sums; products with y and y^2 follow.
_DERIVATIVES = ("u", "v", "ux", "uy", "vx", "vy", "1", "L")
_PRODUCTS = {"uu": 0, "uv": 3, "vv": 6, "1u": 9, "1v": 11, "Lu": 13, "Lv": 15}
_PRODUCTS |= {"11": 17, "1L": 18, "LL": 19}
# Lower half of the normal matrix: row, column, offset of the column sums, and power of x.
_ENTRIES = np.array(
    [
        (
            i,
            j,
            _PRODUCTS["".join(sorted(one[0] + other[0]))] + (one + other).count("y"),
            (one + other).count("x"),
        )
        for i, one in enumerate(_DERIVATIVES)
        for j, other in enumerate(_DERIVATIVES[: i + 1])
    ]
)
_X_POWERS = np.vander(np.arange(-WINDOW_HALF_PX, WINDOW_HALF_PX + 1.0), 3, increasing=True).T.copy()


@kernel
def _fill_templates(
    patch: np.ndarray,
    point: Float,
    variance: float,
    square_misfit: float,
    rows: np.ndarray,
    window: Float,
    factor: Float,
    tolerated: Float,
) -> None:
    """Fill rows of the last three arguments, see `Templates.fill`."""
    shown, down = np.empty((_SIDE_PX + 2) ** 2), np.empty(len(_AT) * WIDE)
    for n in range(len(rows)):
        i = rows[n]
        tolerated[i] = NO_FIT
        middle, reach = patch.shape[1] // 2, max(abs(point[n, 0]), abs(point[n, 1]))
        if reach + WINDOW_HALF_PX + 2 > middle:
            continue
        # Interpolate the grey levels of the window and of a margin of one pixel bilinearly. All
        # pixels have the same fractional position.
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
        # Copy the window's grey levels and compute their slopes.
        wide = np.uintp(_SIDE_PX + 2)
        one = np.uintp(1)
        for y in range(_SIDE_PX):
            for x in range(_SIDE_PX):
                k, at = np.uintp(y * _SIDE_PX + x), np.uintp(y + 1) * wide + np.uintp(x + 1)
                window[i, LEVEL, k] = shown[at]
                window[i, SLOPE_U, k] = 0.5 * (shown[at + one] - shown[at - one])
                window[i, SLOPE_V, k] = 0.5 * (shown[at + wide] - shown[at - wide])
        # Column sums of all products, in `down`; these loops are vectorised.
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
        # Lower half of the normal matrix.
        for e in range(len(_ENTRIES)):
            first, power, total = np.uintp(_ENTRIES[e, 2]) * np.uintp(WIDE), _ENTRIES[e, 3], 0.0
            for x in range(_SIDE_PX):
                total += down[first + np.uintp(x)] * _X_POWERS[power, x]
            factor[i, _ENTRIES[e, 0], _ENTRIES[e, 1]] = total
        # An error e of the place changes a grey level by g e, g its slope along the error. The mean
        # of g^2 over all directions is half the squared gradient.
        square_slopes = factor[i, 0, 0] + factor[i, 1, 1]
        sum_of_squares = variance * factor[i, 6, 6] + 0.5 * square_misfit * square_slopes
        if cholesky(factor[i], _SINGULAR):
            tolerated[i] = sum_of_squares


_MAX_STEPS = 15
_CONVERGED_PX = 0.005  # largest step; far below the effect of noise
_LEAST_SCALE = 0.5  # smallest 1 + h'x: a stronger perspective is no view of a wall
_ONE = np.uintp(1)  # unsigned indices need no wraparound check

_PIXEL_AT = tuple(np.uintp(k * WIDE) for k in range(7))  # offsets of the column sums
_BYTE, _HALF, _LOW = np.uint32(8), np.uint32(16), np.uint32(0xFF)


def fit_patches(
    templates: Templates, rows: np.ndarray, after: np.ndarray, warp: Float, bend: Float
) -> np.ndarray:
    """Fit the warp of each template to a patch of a later image, in place.

    Args:
        templates: windows of earlier images.
        rows: rows of the templates, shape (N,).
        after: patches of the later image, shape (N, P, P) uint8.
        warp: initial maps, correct to a few pixels, shape (N, 2, 3). Columns are d(u, v)/du,
            d(u, v)/dv, and the point's position from the middle of `after`.
        bend: h of each point, per pixel, shape (N, 2).

    Returns:
        Shape (N,) bool: False where the window leaves the patch, has too little texture, or does
        not agree with the template.
    """
    return _fit_patches(
        templates.window, templates.factor, templates.tolerated, rows, after, warp, bend
    )


@kernel
def _fit_patches(
    window: Float,
    factor: Float,
    tolerated: Float,
    rows: np.ndarray,
    after: np.ndarray,
    warp: Float,
    bend: Float,
) -> np.ndarray:
    """Fit all warps and return the mask (N,) of the good fits, see `fit_patches`."""
    found, area = np.zeros(len(rows), np.bool_), len(WEIGHT)
    cell, share, residual = np.empty(area, np.uint32), np.empty((2, area)), np.empty(area)
    down = np.empty(len(_PIXEL_AT) * WIDE)
    side, step = np.uintp(after.shape[2]), np.empty(N_PARAMETERS)
    for n in range(len(rows)):
        i, own, patch = rows[n], warp[n], after[n].ravel()
        if tolerated[i] < 0:
            continue
        square = -1.0
        for _ in range(_MAX_STEPS):
            if not _map_window(after.shape[1], own, bend[n], cell, share):
                break
            # Residuals after - before. The four grey levels around each position are packed into
            # one word first: memory access and arithmetic in separate loops vectorise.
            for k in range(len(cell)):
                at = np.uintp(cell[k])
                upper = np.uint32(patch[at]) | np.uint32(patch[at + _ONE]) << _BYTE
                lower = np.uint32(patch[at + side]) | np.uint32(patch[at + side + _ONE]) << _BYTE
                cell[k] = upper | lower << _HALF
            for k in range(len(cell)):
                a, b, levels = share[0, k], share[1, k], cell[k]
                p, q = float(levels & _LOW), float((levels >> _BYTE) & _LOW)
                r, s = float((levels >> _HALF) & _LOW), float(levels >> (_HALF + _BYTE))
                top, bottom = (1 - a) * p + a * q, (1 - a) * r + a * s
                residual[k] = (1 - b) * top + b * bottom - window[i, LEVEL, k]

            # Weighted sum of squared residuals and J^T W r: first sums per column, in `down`.
            for k in range(len(down)):
                down[k] = 0.0
            for row in range(_SIDE_PX):
                y, first = float(row - WINDOW_HALF_PX), np.uintp(row * _SIDE_PX)
                for x in range(_SIDE_PX):
                    m, k = np.uintp(x), first + np.uintp(x)
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
            total = m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = 0.0
            for k in range(_SIDE_PX):
                m, x = np.uintp(k), float(k - WINDOW_HALF_PX)
                along_u, along_v = down[m + _PIXEL_AT[1]], down[m + _PIXEL_AT[2]]
                total, m0, m1 = total + down[m], m0 + along_u, m1 + along_v
                m2, m3 = m2 + along_u * x, m3 + down[m + _PIXEL_AT[3]]
                m4, m5 = m4 + along_v * x, m5 + down[m + _PIXEL_AT[4]]
                m6, m7 = m6 + down[m + _PIXEL_AT[5]], m7 + down[m + _PIXEL_AT[6]]
            step[0], step[1], step[2], step[3] = m0, m1, m2, m3
            step[4], step[5], step[6], step[7] = m4, m5, m6, m7

            # Solve by the Cholesky factor; the step reduces the squares, gain and offset wholly.
            solve_lower(factor[i], step)
            for k in range(N_PARAMETERS):
                total -= step[k] ** 2
            solve_upper(factor[i], step)

            # Compose the warp with the inverse of the step, which moved the earlier image. First
            # order in h: steps converge to zero, and the neglected terms with them.
            a, b, c, d = 1 + step[2], step[3], step[4], 1 + step[5]
            determinant = a * d - b * c
            for r in range(2):
                by_u, by_v = own[r, 0], own[r, 1]
                own[r, 0] = (by_u * d - by_v * c) / determinant
                own[r, 1] = (by_v * a - by_u * b) / determinant
                own[r, 2] -= own[r, 0] * step[0] + own[r, 1] * step[1]
            if abs(step[0]) < _CONVERGED_PX and abs(step[1]) < _CONVERGED_PX:
                square = max(total, 0.0)
                break
        found[n] = 0 <= square <= tolerated[i]
    return found


@kernel(error_model="numpy")  # without checks for division by zero, which slow the loop down
def _map_window(side: int, warp: Float, bend: Float, cell: np.ndarray, share: Float) -> bool:
    """Map a window's pixels to a patch; False if the window leaves the patch.

    Args:
        side: side of the patch, pixels.
        warp: map of the point's neighbourhood, shape (2, 3).
        bend: h, shape (2,).
        cell: index of the pixel at the upper left of each position, shape (W * W,); filled in.
        share: fractional parts of each position along u and v, shape (2, W * W); filled in.
    """
    half, middle, h_u, h_v = WINDOW_HALF_PX, side // 2, bend[0], bend[1]
    least = 1.0 - (abs(h_u) + abs(h_v)) * half
    if not least > _LEAST_SCALE:
        return False
    for r in range(2):
        across = (abs(warp[r, 0]) + abs(warp[r, 1])) * half
        if not across / least + abs(warp[r, 2]) + 1 <= middle:
            return False
    uu, uv, u_0 = warp[0, 0], warp[0, 1], warp[0, 2]
    vu, vv, v_0 = warp[1, 0], warp[1, 1], warp[1, 2]
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
    return True
