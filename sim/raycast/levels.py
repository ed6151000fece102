"""Floor and ceiling: what a pixel's footprint on them shows on average.

A row of a level camera's picture shows a level plane at one depth, Z = h f / |v - c|. A footprint
is Z / f wide and Z^2 / (h f) deep: far off it is long and narrow, turned against the picture's
texels: it is filled with bilinear samples all along it, from the copy whose texels are as
large as it is wide (Heckbert 1989, section 3; McCormack et al. 1999, Feline).
"""

import numpy as np
from numba import njit

from sim.raycast.plan import Pinhole
from sim.raycast.scene import Level

BACKGROUND = 255.0  # grey level of what is nowhere, as PyBullet has it
MOST_SAMPLES = 64  # along a footprint
STEP_TEXELS = 2.0  # between samples; floors are painted with a low pass of one texel
UNIT, LOW, PER_UNIT = 2.0**32, 2**32 - 1, np.float32(2.0**-32)
COVERED = 1 - 1e-6  # shares are kept in single precision


@njit(cache=True)
def row_depth_m(camera: Pinhole, height_m: float, v: float) -> float:
    """Depth at which a ray through row `v` meets a level plane; infinity if it does not."""
    down = (v - camera.center_v) / camera.focal_px
    drop = camera.eye_z_m - height_m
    return drop / down if drop * down > 0 else np.inf


@njit(cache=True)
def footprints(camera: Pinhole, level: Level) -> np.ndarray:
    """How each row is sampled (H, 3) int64: samples along, samples across, copy of the picture."""
    plan = np.zeros((camera.height_px, 3), dtype=np.int64)
    per_m = level.shape[0, 1] / level.size_m[0]
    for i in range(camera.height_px):
        z = row_depth_m(camera, level.height_m, float(i))
        inner = row_depth_m(camera, level.height_m, i - 0.5)
        outer = row_depth_m(camera, level.height_m, i + 0.5)
        if not (np.isfinite(inner) and np.isfinite(outer)):
            continue
        across, along, k = z / camera.focal_px * per_m, abs(outer - inner) * per_m, 0
        while across > 2 and k < len(level.first) - 1:
            across, along, k = across / 2, along / 2, k + 1
        plan[i, 0] = min(max(np.ceil(along / STEP_TEXELS), 1), MOST_SAMPLES)
        plan[i, 1] = 1 if across <= 1 else 2
        plan[i, 2] = k
    return plan


@njit(cache=True)
def shares(camera: Pinhole, level: Level, u: float) -> tuple[float, float, float, float]:
    """A column's way over a picture: right = a + b Z, up = c + d Z, both 0 to 1 on the picture."""
    cos, sin = np.cos(camera.theta), np.sin(camera.theta)
    y = (camera.center_u - u) / camera.focal_px
    x0, y0 = camera.eye_x_m - level.corner_m[0], camera.eye_y_m - level.corner_m[1]
    dx, dy = cos - y * sin, sin + y * cos
    right, up = level.right_per_m2, level.up_per_m2
    return (
        right[0] * x0 + right[1] * y0,
        right[0] * dx + right[1] * dy,
        up[0] * x0 + up[1] * y0,
        up[0] * dx + up[1] * dy,
    )


@njit(cache=True)
def fill(
    camera: Pinhole, level: Level, plan: np.ndarray, picture: np.ndarray, covered: np.ndarray
) -> None:
    """Add what a level plane shows in the shares of pixels that are not covered yet.

    Row by row: there the depth is one, and footprints lie side by side on a line.

    Args:
        camera: level.
        level: floor or ceiling.
        plan: from `footprints`.
        picture: (H, W) grey levels times covered share, added to.
        covered: (H, W) covered share of each pixel; 1 where the plane fills the rest.
    """
    grey = np.empty(camera.width_px, dtype=np.float32)
    for v in range(camera.height_px):
        if plan[v, 0] == 0:
            continue
        begin = 0
        while begin < camera.width_px:
            end = begin
            while end < camera.width_px and covered[v, end] <= COVERED:
                end += 1
            if begin < end:
                _means(camera, level, plan[v], v, begin, end, grey)
                for j in range(begin, end):
                    picture[v, j] += (1 - covered[v, j]) * grey[j]
                    covered[v, j] = 1.0
            begin = end + 1


@njit(cache=True)
def _means(
    camera: Pinhole, level: Level, plan: np.ndarray, v: int, begin: int, end: int, grey: np.ndarray
) -> None:
    """Write into `grey` (W,) float32 the means of a row's pixels from `begin` until `end`."""
    n, across, k = plan
    height, width = level.shape[k]
    rise = (camera.eye_z_m - level.height_m) * camera.focal_px
    for j in range(begin, end):
        grey[j] = 0.0
    for side in range(across):
        aside = 0.0 if across == 1 else side / 2 - 0.25
        right_0, right_z, up_0, up_z = shares(camera, level, begin + aside)
        _, right_last, _, up_last = shares(camera, level, end - 1 + aside)
        for s in range(n):
            z = rise / (v - 0.5 + (s + 0.5) / n - camera.center_v)
            x, y = (right_0 + right_z * z) * width - 0.5, (up_0 + up_z * z) * height - 0.5
            x_last = (right_0 + right_last * z) * width - 0.5
            y_last = (up_0 + up_last * z) * height - 0.5
            _add_samples(level, k, x, y, x_last, y_last, grey[begin:end])
    for j in range(begin, end):
        grey[j] /= n * across


@njit(cache=True)
def _add_samples(
    level: Level, k: int, x: float, y: float, x_last: float, y_last: float, grey: np.ndarray
) -> None:
    """Add samples of copy k, N of them on a line, to (N,) float32.

    Places are in texels from the middle of the first one.
    """
    height, width = level.shape[k]
    steps = max(len(grey) - 1, 1)
    x_step, y_step = (x_last - x) / steps, (y_last - y) / steps
    # with both ends all of a line is between the middles of the outermost texels
    low, high = min(x, x_last), max(x, x_last)
    inside = low >= 0 and high < width - 1
    low, high = min(y, y_last), max(y, y_last)
    if not (inside and low >= 0 and high < height - 1):
        for i in range(len(grey)):
            grey[i] += _at_the_edge(level, k, x + i * x_step, y + i * y_step)
        return
    # whole numbers of 2^-32 texels, and places without a sign: half the time of floating point
    texels, wide, one = level.texels[level.first[k] :], np.uint64(width), np.uint64(1)
    at_x, at_y = np.int64(x * UNIT), np.int64(y * UNIT)
    x_step, y_step = np.int64(x_step * UNIT), np.int64(y_step * UNIT)
    for i in range(len(grey)):
        here = np.uint64(at_y >> 32) * wide + np.uint64(at_x >> 32)
        a, b = np.float32(at_x & LOW) * PER_UNIT, np.float32(at_y & LOW) * PER_UNIT
        low_0, low_1 = texels[here], texels[here + one]
        high_0, high_1 = texels[here + wide], texels[here + wide + one]
        low, high = low_0 + a * (low_1 - low_0), high_0 + a * (high_1 - high_0)
        grey[i] += low + b * (high - low)
        at_x += x_step
        at_y += y_step


@njit(cache=True)
def _at_the_edge(level: Level, k: int, x: float, y: float) -> float:
    """A sample anywhere: within half a texel of the picture's edge, or beside it: nothing there."""
    height, width = level.shape[k]
    if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
        return BACKGROUND
    x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
    column, row = int(x), int(y)
    here = level.first[k] + row * width + column
    aside = 1 if column + 1 < width else 0
    above = here + width if row + 1 < height else here
    low = level.texels[here] + (x - column) * (level.texels[here + aside] - level.texels[here])
    high = level.texels[above] + (x - column) * (level.texels[above + aside] - level.texels[above])
    return float(low + (y - row) * (high - low))


@njit(cache=True)
def texel(level: Level, right: float, up: float) -> float:
    """The texel that a point of the picture lies on; the background beside it."""
    if not (0 <= right < 1 and 0 <= up < 1):
        return BACKGROUND
    height, width = level.shape[0]
    return float(level.texels[int(up * height) * width + int(right * width)])
