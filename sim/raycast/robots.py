"""The other robots in a picture: flat solids, drawn from the nearest to the farthest.

A picture of a convex solid is bounded by the edges between faces that it turns to the eye and
others, and walls reach from the floor to the ceiling, so whether a wall hides a solid is decided
column by column in plan.
"""

import numpy as np

from mapfusion.kernels import kernel
from mapfusion.se2 import Float
from sim.raycast.outline import fill_coverage, fill_least
from sim.raycast.plan import Pinhole, Plan, inverse_depths
from sim.raycast.solids import Solids, front_to_back
from sim.raycast.windows import Body

_PARALLEL = 1e-12  # of a ray's direction along an axis: it meets no plane across that


def cast(
    camera: Pinhole, solids: Solids, bodies: list[Body], grey: Float, depth_m: np.ndarray,
    picture: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Draw robots into pixels whose middles hit them nearer than `depth_m` (H, W).

    Both `depth_m`, infinity where nothing is, and `picture` (H, W) are changed.
    """
    for body in bodies:
        for i in body.shown.tolist():
            nearness = _nearness(camera, solids, i, body)
            top, bottom, left, right = body.windows[i].tolist()
            _put_nearer(nearness, top, left, depth_m)
            if picture is not None:
                picture[top : bottom + 1, left : right + 1][nearness > 0] = grey[i]


@kernel
def _put_nearer(nearness: Float, top: int, left: int, depth_m: np.ndarray) -> None:
    """Put a window's inverse depths into a picture's where they are nearer; others become 0."""
    height, width = nearness.shape
    for i in range(height):
        for j in range(width):
            if nearness[i, j] * depth_m[top + i, left + j] > 1:
                depth_m[top + i, left + j] = 1 / nearness[i, j]
            else:
                nearness[i, j] = 0.0


def _nearness(camera: Pinhole, solids: Solids, i: int, body: Body) -> Float:
    """Inverse depth of a solid behind its window's pixels; 0 where it is not.

    Inverse depth is linear in the picture on each of its planes. Its surface is the farthest of
    those that face the eye, where a ray has not left it before (Kay and Kajiya 1986).
    """
    top, bottom, left, right = body.windows[i].tolist()
    own, f = slice(*solids.first_plane[i : i + 2]), camera.focal_px
    up = (camera.center_v - np.arange(top, bottom + 1)) / f

    def least(edges: Float, faces: np.ndarray, sign: float) -> Float:
        n, outside_m = solids.planes[own, :3][faces], body.outside_m[own][faces]
        ahead, aside, above = -sign * (body.axes @ n.T) / outside_m
        in_row = ahead + aside * ((camera.center_u - left) / f) + above * up[:, None]
        found = np.zeros((len(up), right + 1 - left))
        fill_least(edges, in_row, -aside / f, found)
        return found

    facing = body.outside_m[own] > 0
    if not body.is_cut[i]:
        return least(body.outline(i), facing, 1.0)
    # of what reaches the lens no outline is known: rays through all pixels of the window
    around = np.array(
        [[-1.0, -1, -1, len(up)], [right + 1.0 - left, len(up), right + 1 - left, -1]]
    )
    nearness = np.minimum(least(around, facing, 1.0), 1 / camera.near_m)
    leaves = -least(around, body.outside_m[own] < 0, -1.0)
    return np.where(nearness > np.maximum(leaves, 0.0), nearness, 0.0)


def draw(
    camera: Pinhole, plan: Plan, solids: Solids, bodies: list[Body], grey: Float,
    picture: np.ndarray,
) -> None:  # fmt: skip
    """Draw robots over a picture (H, W) uint8, each pixel by the share they cover.

    Args:
        camera: level.
        plan: what it sees of the walls.
        solids: of one robot.
        bodies: in the picture, from the nearest to the farthest.
        grey: (S,) the solids' grey levels.
        picture: changed.
    """
    bounds = np.array([body.bounds() for body in bodies])
    (above, first), (below, last) = bounds[:, ::2].min(axis=0), bounds[:, 1::2].max(axis=0)
    under = picture[above:below, first:last].astype(np.float32)
    seen, rest = under.copy(), np.ones_like(under)
    for body in bodies:
        open_share = _open_shares(camera, plan, solids, body, first, last)
        windows = body.windows.tolist()
        for i in front_to_back(solids, body.eye_m):
            top, bottom, left, right = windows[i]
            if top > bottom or left > right:
                continue
            if body.is_cut[i]:  # by the pixels' middles
                covered = (_nearness(camera, solids, i, body) > 0).astype(np.float64)
            else:
                covered = np.zeros((bottom + 1 - top, right + 1 - left))
                fill_coverage(body.outline(i), covered)
            is_open = open_share[i, left - first : right + 1 - first]
            _paint(covered, is_open, grey[i], top - above, left - first, under, rest, seen)
    picture[above:below, first:last] = (seen + 0.5).astype(np.uint8)


@kernel
def _paint(
    covered: Float, open_share: Float, grey: float, top: int, left: int, under: np.ndarray,
    rest: np.ndarray, seen: np.ndarray,
) -> None:  # fmt: skip
    """Draw a solid by the shares of its window's pixels (H, W) and columns (W,), see `draw`.

    What is nearer hides the others where it is, and nowhere else in a pixel.
    """
    height, width = covered.shape
    for i in range(height):
        for j in range(width):
            v, u = top + i, left + j
            share = min(covered[i, j] * open_share[j], rest[v, u])
            rest[v, u] -= share
            seen[v, u] += share * (grey - under[v, u])


def _open_shares(
    camera: Pinhole, plan: Plan, solids: Solids, body: Body, first: int, last: int
) -> Float:
    """Shares (S, N) of columns from `first` to before `last` in which no wall hides a solid."""
    w = inverse_depths(plan, first, last)
    if body.farthest_m * w.max() < 1:  # in front of all walls
        return np.ones((len(body.windows), last - first))
    (ahead_x, ahead_y), (left_x, left_y) = body.axes[:2, :2].tolist()
    low, high = solids.low_m[:, :2] - body.eye_m[:2], solids.high_m[:, :2] - body.eye_m[:2]
    x = np.stack([low[:, 0], low[:, 0], high[:, 0], high[:, 0]])
    y = np.stack([low[:, 1], high[:, 1], low[:, 1], high[:, 1]])
    corner_m, aside_m = ahead_x * x + ahead_y * y, left_x * x + left_y * y
    left = (camera.center_u - np.arange(first, last)) / camera.focal_px
    # depths at which columns meet solids' boxes in plan, or of the corners nearest to them
    enter, leave = np.zeros((len(low), 1)), np.full((len(low), 1), np.inf)
    for axis, ray in enumerate((ahead_x + left * left_x, ahead_y + left * left_y)):
        ray[np.abs(ray) <= _PARALLEL] = np.nan  # which counts neither as least nor as most
        at_low, at_high = low[:, axis, None] / ray, high[:, axis, None] / ray
        enter = np.fmax(enter, np.minimum(at_low, at_high))
        leave = np.fmin(leave, np.maximum(at_low, at_high))
    off = np.abs(aside_m[:, :, None] - left * corner_m[:, :, None])
    off /= np.maximum(corner_m, camera.near_m)[:, :, None]
    nearest_m = np.take_along_axis(corner_m.T, np.argmin(off, axis=0), axis=1)
    depth_m = np.where(enter <= leave, (enter + leave) / 2, nearest_m)
    begins = plan.first[first : last + 1]
    width = (plan.high - plan.low)[begins[0] : begins[-1]]
    share = np.where(np.repeat(depth_m, np.diff(begins), axis=1) * w < 1, width, 0.0)
    return np.add.reduceat(share, begins[:-1] - begins[0], axis=1)
