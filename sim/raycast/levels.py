"""Floor and ceiling: what a pixel's footprint on them shows on average.

A row of a level camera's picture shows a level plane at one depth, Z = h f / |v - c|. A footprint
is Z / f wide and Z^2 / (h f) deep: far off it is long and narrow, turned against the picture's
texels: it is filled with bilinear samples all along it, from the copy whose texels are as
large as it is wide (Heckbert 1989, section 3; McCormack et al. 1999, Feline).
"""

import numpy as np
from numba import njit

from mapfusion.se2 import Float
from sim.raycast.plan import Pinhole
from sim.raycast.scene import Level

BACKGROUND = 255.0  # grey level of what is nowhere, as PyBullet has it
MOST_SAMPLES = 64  # along a footprint
STEP_TEXELS = 2.0  # between samples; floors are painted with a low pass of one texel
COVERED = 1 - 1e-9


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
    camera: Pinhole, level: Level, plan: np.ndarray, j: int, total: Float, covered: Float
) -> None:
    """Add to column j's pixels what a level plane shows in the shares that are not covered yet.

    Args:
        camera: level.
        level: floor or ceiling.
        plan: from `footprints`.
        j: the column.
        total: (H,) grey levels times covered share, added to.
        covered: (H,) covered share of each pixel.
    """
    rise = (camera.eye_z_m - level.height_m) * camera.focal_px
    right_0, right_z, up_0, up_z = shares(camera, level, float(j))
    _, right_aside, _, up_aside = shares(camera, level, j + 0.25)
    right_aside, up_aside = right_aside - right_z, up_aside - up_z
    texels = level.texels
    for v in range(camera.height_px):
        n, across, k = plan[v, 0], plan[v, 1], plan[v, 2]
        if n == 0 or covered[v] > COVERED:
            continue
        height, width, first = level.shape[k, 0], level.shape[k, 1], level.first[k]
        grey, sign = 0.0, 0.0 if across == 1 else -1.0
        for _ in range(across):
            r, u = right_z + sign * right_aside, up_z + sign * up_aside
            x_0, x_z = right_0 * width - 0.5, r * width
            y_0, y_z = up_0 * height - 0.5, u * height
            for s in range(n):
                z = rise / (v - 0.5 + (s + 0.5) / n - camera.center_v)
                x, y = x_0 + x_z * z, y_0 + y_z * z
                if 0 <= x < width - 1 and 0 <= y < height - 1:
                    column, row = int(x), int(y)
                    a, b = x - column, y - row
                    here = first + row * width + column
                    low = texels[here] + a * (texels[here + 1] - texels[here])
                    here += width
                    high = texels[here] + a * (texels[here + 1] - texels[here])
                    grey += low + b * (high - low)
                else:
                    grey += _at_the_edge(level, k, x, y)
            sign = 1.0
        total[v] += (1 - covered[v]) * grey / (n * across)
        covered[v] = 1.0


@njit(cache=True)
def _at_the_edge(level: Level, k: int, x: float, y: float) -> float:
    """A sample within half a texel of the picture's edge, or beside it, where there is nothing."""
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
