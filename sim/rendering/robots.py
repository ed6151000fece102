"""Other robots in an image: convex solids read from a URDF, drawn by coverage from far to near.

Each edge adds, to the pixels that it crosses in a row, the change of the covered area to its right;
sums from the left are the covered shares (Levien 2016, font-rs; the same as FreeType's "cells").

The image of a convex solid is bounded by its silhouette edges, between faces towards the camera and
faces away from it. Walls reach from the floor to the ceiling, so the occlusion of solids by walls
is computed per column in plan.
"""

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.geometry.numerics import Float, kernel
from sim.rendering.walls import Pinhole, VisibleWalls, inverse_depths

MARGIN_M = 0.001  # PyBullet draws cylinders larger by this margin

_Hull = tuple[Float, np.ndarray, np.ndarray]  # planes, edges and sides, see `Solids`


class Solids(NamedTuple):
    """Convex solids of one robot at rest in its frame, the floor at z = 0.

    Corners, triangular faces and edges of all S solids are concatenated.

    Attributes:
        corners_m: corners, shape (N, 3).
        first_corner: start of each solid's corners, and N, shape (S + 1,) int64.
        planes: outward normals n and offsets d of the faces, shape (P, 4); inside, n p <= d.
        first_plane: start of each solid's faces, and P, shape (S + 1,) int64.
        edges: corners of the edges, shape (E, 2) int64. Seen from outside, the first face of
            `sides` lies to the left of the edge.
        sides: faces on both sides of the edges, shape (E, 2) int64.
        first_edge: start of each solid's edges, and E, shape (S + 1,) int64.
        low_m: lowest corners of the bounding boxes, shape (S, 3).
        high_m: highest corners of the bounding boxes, shape (S, 3).
        rgb: displayed colours, 0 to 255, shape (S, 3) float64.
        reach_m: largest distance of a corner from the origin in plan.
    """

    corners_m: Float
    first_corner: np.ndarray
    planes: Float
    first_plane: np.ndarray
    edges: np.ndarray
    sides: np.ndarray
    first_edge: np.ndarray
    low_m: Float
    high_m: Float
    rgb: Float
    reach_m: float


def read_solids(urdf: Path) -> Solids:
    """Read boxes and cylinders of a URDF's links, with all joints in their zero position."""
    root = ElementTree.parse(urdf).getroot()  # noqa: S314 - a file of our own
    colours = {m.attrib["name"]: _numbers(m.find("color"), "rgba") for m in root.iter("material")
               if m.find("color") is not None}  # fmt: skip
    places = {_named(j, "child"): _numbers(j.find("origin"), "xyz") for j in root.iter("joint")}
    corners_m, planes, edges, sides, rgb = [], [], [], [], []
    for link in root.iter("link"):
        place = places.get(link.attrib["name"], np.zeros(3))
        for visual in link.iter("visual"):
            own_corners, hull = _shape(visual, place)
            edges.append(hull[1] + sum(map(len, corners_m)))
            sides.append(hull[2] + sum(map(len, planes)))
            corners_m.append(own_corners)
            planes.append(hull[0])
            rgb.append(np.floor(255 * colours[_named(visual, "material", "name")][:3]))
    return Solids(
        np.concatenate(corners_m),
        _begins(corners_m),
        np.concatenate(planes),
        _begins(planes),
        np.concatenate(edges),
        np.concatenate(sides),
        _begins(edges),
        np.array([own.min(axis=0) for own in corners_m]),
        np.array([own.max(axis=0) for own in corners_m]),
        np.array(rgb),
        float(np.linalg.norm(np.concatenate(corners_m)[:, :2], axis=1).max()),
    )


def _begins(parts: list[np.ndarray]) -> np.ndarray:
    """Return the start of each part in their concatenation, and its length."""
    return np.cumsum([0, *(len(part) for part in parts)])


def _numbers(element: ElementTree.Element | None, name: str) -> Float:
    """Return the numbers in an attribute; zeros without the element or attribute."""
    words = "0 0 0" if element is None else element.attrib.get(name, "0 0 0")
    return np.array([float(word) for word in words.split()])


def _named(element: ElementTree.Element, child: str, name: str = "link") -> str:
    """Return an attribute of a child element."""
    child_element = element.find(child)
    assert child_element is not None
    return child_element.attrib[name]


def _shape(visual: ElementTree.Element, place_m: Float) -> tuple[Float, _Hull]:
    """Return corners (K, 3) and hull of a box or a cylinder in the robot's frame."""
    origin, box = visual.find("origin"), visual.find("geometry/box")
    if box is not None:
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners = signs * _numbers(box, "size") / 2
    else:
        cylinder = visual.find("geometry/cylinder")
        assert cylinder is not None
        radius, half_m = float(cylinder.attrib["radius"]), float(cylinder.attrib["length"]) / 2
        corners = _cylinder_corners(radius, half_m)
    # edges between two triangles, seen from outside with the first triangle to the left
    hull = scipy.spatial.ConvexHull(corners)
    a, b, c = np.moveaxis(corners[hull.simplices], 1, 0)
    normals = hull.equations[:, :3]
    turned = np.sum(np.cross(b - a, c - a) * normals, axis=1) < 0
    edges, sides = [], []
    for i, (corner, beside) in enumerate(zip(hull.simplices, hull.neighbors, strict=True)):
        for k in range(3):  # the edge opposite to corner k
            if i < beside[k]:
                other_corners = [corner[(k + 1) % 3], corner[(k + 2) % 3]]
                edges.append(other_corners[::-1] if turned[i] else other_corners)
                sides.append([i, beside[k]])
    planes = hull.equations.round(9) * [1, 1, 1, -1]
    # roll, pitch and yaw of a URDF are about fixed axes
    (cr, cp, cy), (sr, sp, sy) = (
        function(_numbers(origin, "rpy")) for function in (np.cos, np.sin)
    )
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    R, at = about_z @ about_y @ about_x, _numbers(origin, "xyz")
    planes[:, :3] = planes[:, :3] @ R.T
    planes[:, 3] += planes[:, :3] @ at
    planes[:, 3] += planes[:, :3] @ place_m
    return corners @ R.T + at + place_m, (planes, np.array(edges), np.array(sides))


def _cylinder_corners(radius: float, half_m: float) -> Float:
    """Return corners (42, 3) of the shape that PyBullet displays for a cylinder along z.

    PyBullet (`btShapeHull`) takes a prism with 32 sides. It keeps the farthest corners in 42
    directions, those to the corners and edges of an icosahedron, and moves them out by a margin.
    """
    angle = 2 * np.pi * np.arange(32) / 32
    rim = np.column_stack([radius * np.sin(angle), radius * np.cos(angle)])
    prism = np.stack([np.insert(rim, 2, z, axis=1) for z in (half_m, -half_m)], 1).reshape(-1, 3)
    around = 2 * np.pi * np.arange(5) / 5
    ring = np.column_stack([2 * np.cos(around), 2 * np.sin(around), np.ones(5)]) / np.sqrt(5)
    twelve = np.vstack([[[0, 0, 1]], ring * [-1, 1, -1], ring * [1, 1, 1], [[0, 0, -1]]])
    twelve[1:6, 2], twelve[6:11, 2] = -1 / np.sqrt(5), 1 / np.sqrt(5)
    first, second = np.triu_indices(len(twelve), 1)
    is_edge = np.sum(twelve[first] * twelve[second], axis=1) > 0.4
    edges = twelve[first[is_edge]] + twelve[second[is_edge]]
    directions = np.vstack([twelve, edges / np.linalg.norm(edges, axis=1, keepdims=True)])
    assert len(directions) == 42
    return prism[np.argmax((directions @ prism.T).round(9), axis=1)] + MARGIN_M * directions


def front_to_back(solids: Solids, eye_m: Float) -> list[int]:
    """Return an order of the S solids in which no solid hides an earlier one.

    The bounding boxes do not overlap, so an axis-aligned plane separates any two. The solid on the
    camera's side of the plane cannot be hidden by the other one.

    Args:
        solids: solids of one robot.
        eye_m: optical centre in the robot's frame, shape (3,).
    """
    low, high = solids.low_m, solids.high_m
    in_front = (high[:, None] <= low + 1e-9) & (eye_m <= low)
    in_front |= (low[:, None] >= high - 1e-9) & (eye_m >= high)
    unhidden = (in_front.any(axis=2) | np.eye(len(low), dtype=bool)).tolist()
    order, left = list[int](), list(range(len(low)))
    while left:
        first = (i for i in left if all(unhidden[i][j] for j in left))
        order.append(next(first, left[0]))
        left.remove(order[-1])
    return order


_LEAST_WIDTH_PX = 1e-12  # least width of an edge within a row, to avoid division by zero


@kernel
def fill_coverage(edges: Float, covered: Float) -> None:
    """Fill in the covered shares of a window's pixels.

    Args:
        edges: edges of the outline in any order, all in the same sense of rotation: start and end
            (u, v, u, v), shape (E, 4). The first pixel of the window has its centre at (0, 0).
        covered: zeros, shape (H, W); changed to the covered shares.
    """
    height, width = covered.shape
    for k in range(len(edges)):
        u_0, v_0, u_1, v_1 = edges[k, 0], edges[k, 1], edges[k, 2], edges[k, 3]
        # relative to the upper left corner of the window
        u_0, v_0, u_1, v_1 = u_0 + 0.5, v_0 + 0.5, u_1 + 0.5, v_1 + 0.5
        if v_0 == v_1:
            continue
        sign = 1.0 if v_0 < v_1 else -1.0
        if v_0 > v_1:
            u_0, v_0, u_1, v_1 = u_1, v_1, u_0, v_0
        slope, least, most = (u_1 - u_0) / (v_1 - v_0), min(u_0, u_1), max(u_0, u_1)
        for row in range(max(int(np.floor(v_0)), 0), min(int(np.ceil(v_1)), height)):
            top, bottom = max(float(row), v_0), min(row + 1.0, v_1)
            at_top = min(max(u_0 + slope * (top - v_0), least), most)
            at_bottom = min(max(u_0 + slope * (bottom - v_0), least), most)
            left, right = min(at_top, at_bottom), max(at_top, at_bottom)
            # parts left of the window count in the first column
            first, last = max(int(np.floor(left)), 0), max(int(np.floor(right)) + 1, 0)
            area, before = _area(left, right, float(first)), 0.0
            for column in range(first, min(last + 1, width)):
                area_after = _area(left, right, column + 1.0)
                share = sign * (bottom - top) * (area_after - area)
                covered[row, column] += share - before
                area, before = area_after, share
    for row in range(height):
        total = 0.0
        for column in range(width):
            total += covered[row, column]
            covered[row, column] = min(abs(total), 1.0)


@kernel
def _area(left: float, right: float, border: float) -> float:
    """Return the area between an edge from `left` to `right` of unit height and a border."""
    inside = min(max(border - left, 0.0), right - left)
    return inside * inside / (2 * max(right - left, _LEAST_WIDTH_PX)) + max(border - right, 0.0)


@kernel
def fill_minimum(edges: Float, in_row: Float, per_column: Float, least: Float) -> None:
    """Fill in the minimum of K linear functions at pixels whose centres lie in an outline.

    Args:
        edges: edges of the outline, see `fill_coverage`.
        in_row: values of the functions in the first column, shape (H, K).
        per_column: change of the functions per column, shape (K,).
        least: changed to the minimum within the outline, shape (H, W).
    """
    height, width = least.shape
    for row in range(height):
        begin, stop = np.inf, -np.inf
        for k in range(len(edges)):
            u_0, v_0, u_1, v_1 = edges[k, 0], edges[k, 1], edges[k, 2], edges[k, 3]
            if min(v_0, v_1) <= row <= max(v_0, v_1) and v_0 != v_1:
                u = u_0 + (row - v_0) / (v_1 - v_0) * (u_1 - u_0)
                begin, stop = min(begin, u), max(stop, u)
        begin, stop = max(np.ceil(begin), 0.0), min(np.floor(stop), width - 1.0)
        if begin > stop:
            continue
        first, last = int(begin), int(stop)
        inside = least[row, first : last + 1]
        for i in range(len(inside)):
            inside[i] = np.inf
        for k in range(len(per_column)):
            step = per_column[k]
            at = in_row[row, k] + step * first
            for i in range(len(inside)):
                inside[i] = min(inside[i], at + step * i)


class ProjectedRobot(NamedTuple):
    """Robot projected into a camera.

    Attributes:
        eye_m: optical centre in the robot's frame, shape (3,).
        axes: camera axes ahead, left and up in the robot's frame, shape (3, 3).
        outside_m: distance of the optical centre in front of each face's plane, shape (P,).
        windows: first and last row, first and last column that may show each solid, shape (S, 4).
        shown: indices of the solids that may be visible, shape (N,).
        is_cut: True for solids that reach the near plane, shape (S,).
        farthest_m: largest depth of a corner.
        outline_px: silhouette edges (u, v, u, v) in the window of their solid, whose first pixel
            has its centre at (0, 0), shape (M, 4).
        first_edge: start of each solid's silhouette edges, and M, shape (S + 1,) int64.
    """

    eye_m: Float
    axes: Float
    outside_m: Float
    windows: np.ndarray
    shown: np.ndarray
    is_cut: np.ndarray
    farthest_m: float
    outline_px: Float
    first_edge: np.ndarray

    def bounds(self) -> tuple[int, int, int, int]:
        """Return the first row, the row after the last, and the same of the columns."""
        top, bottom, left, right = self.windows[self.shown].T
        return int(top.min()), int(bottom.max()) + 1, int(left.min()), int(right.max()) + 1

    def outline(self, i: int) -> Float:
        """Return the silhouette edges (E, 4) of a solid."""
        return self.outline_px[self.first_edge[i] : self.first_edge[i + 1]]


def project_robot(camera: Pinhole, solids: Solids, pose: Float) -> ProjectedRobot:
    """Project a robot at a pose (3,) into a camera."""
    # optical centre, and axes ahead, left and up, in the robot's frame
    theta = float(pose[2])
    cos, sin = math.cos(theta), math.sin(theta)
    dx, dy = camera.eye_x_m - pose[0], camera.eye_y_m - pose[1]
    eye = np.array([cos * dx + sin * dy, cos * dy - sin * dx, camera.eye_z_m])
    cos, sin = math.cos(camera.theta - theta), math.sin(camera.theta - theta)
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    outside = solids.planes[:, :3] @ eye - solids.planes[:, 3]
    x, y, up = (solids.corners_m - eye).T
    ahead, left = axes[0, 0] * x + axes[0, 1] * y, axes[1, 0] * x + axes[1, 1] * y
    begins, behind = solids.first_corner[:-1], ahead <= camera.near_m
    uv = _project(camera, np.where(behind, camera.near_m, ahead), left, up)
    low, high = uv, uv
    if behind.any():
        low, high = np.where(behind[:, None], [[[np.inf]], [[-np.inf]]], uv)
    low, high = np.minimum.reduceat(low, begins), np.maximum.reduceat(high, begins)
    if behind.any():  # edges that cross the near plane
        meets = behind[solids.edges[:, 0]] != behind[solids.edges[:, 1]]
        begin, end = solids.edges[meets].T
        t = (ahead[begin] - camera.near_m) / (ahead[begin] - ahead[end])
        met_left, met_up = (at[begin] + t * (at[end] - at[begin]) for at in (left, up))
        met = _project(camera, np.full(len(t), camera.near_m), met_left, met_up)
        solid_of_edge = np.searchsorted(solids.first_corner, begin, side="right") - 1
        np.minimum.at(low, solid_of_edge, met)
        np.maximum.at(high, solid_of_edge, met)
    # windows from the least and largest u and v of all points of each solid
    size = np.array([camera.width_px, camera.height_px])
    first = np.minimum(np.maximum(np.floor(low + 0.5), 0), size)
    last = np.maximum(np.minimum(np.floor(high + 0.5), size - 1), -1)
    windows = np.stack([first[:, 1], last[:, 1], first[:, 0], last[:, 0]], axis=-1)
    windows = windows.astype(np.int64)
    is_cut = np.logical_or.reduceat(behind, begins)
    top, bottom, leftmost, rightmost = windows.T
    visible_solids = np.flatnonzero((top <= bottom) & (leftmost <= rightmost))
    # silhouette edges: between a face towards the camera and one away from it, which is to the left
    sees = outside[solids.sides] > 0
    bounding = np.flatnonzero(sees[:, 0] != sees[:, 1])
    ends = np.where(sees[bounding, :1], solids.edges[bounding], solids.edges[bounding, ::-1])
    first_edge = np.searchsorted(bounding, solids.first_edge)
    corner = np.repeat(windows[:, [2, 0, 2, 0]], np.diff(first_edge), axis=0)
    outline = uv[ends].reshape(-1, 4) - corner
    farthest_m = float(ahead.max())
    return ProjectedRobot(
        eye, axes, outside, windows, visible_solids, is_cut, farthest_m, outline, first_edge
    )


def within_view(camera: Pinhole, reach_m: float, poses: Float) -> Float:
    """Return the poses at which robots may be visible without walls, the nearest first.

    Args:
        camera: level camera.
        reach_m: radius of a robot in plan.
        poses: poses, shape (R, 3).
    """
    cos, sin = math.cos(camera.theta), math.sin(camera.theta)
    x, y = poses[:, 0] - camera.eye_x_m, poses[:, 1] - camera.eye_y_m
    ahead, aside = cos * x + sin * y, np.abs(cos * y - sin * x)
    # half a pixel to the edge of the last one, and half a pixel margin
    widest = max(camera.center_u, camera.width_px - 1 - camera.center_u) + 1
    beside = aside - ahead * (widest / camera.focal_px)
    limit = reach_m * math.hypot(1, widest / camera.focal_px)
    rows = np.flatnonzero((ahead > -reach_m) & (beside <= limit))
    return poses[rows[np.argsort((x * x + y * y)[rows], kind="stable")]]


def is_occluded(camera: Pinhole, visible_walls: VisibleWalls, reach_m: float, pose: Float) -> bool:
    """Return True if walls hide the circle of radius `reach_m` around a robot's pose (3,)."""
    cos, sin = math.cos(camera.theta), math.sin(camera.theta)
    x, y = float(pose[0]) - camera.eye_x_m, float(pose[1]) - camera.eye_y_m
    ahead, aside = cos * x + sin * y, cos * y - sin * x
    nearest, farthest = ahead - reach_m, ahead + reach_m
    left, right = aside + reach_m, aside - reach_m
    if nearest <= camera.near_m:
        return False
    u_left = camera.center_u - camera.focal_px * left / (nearest if left > 0 else farthest)
    u_right = camera.center_u - camera.focal_px * right / (nearest if right < 0 else farthest)
    first = max(math.floor(u_left + 0.5), 0)
    last = min(math.floor(u_right + 0.5) + 1, camera.width_px)
    return first >= last or bool(nearest * inverse_depths(visible_walls, first, last).min() >= 1)


def _project(camera: Pinhole, ahead: Float, left: Float, up: Float) -> Float:
    """Return pixels (N, 2) of points in front of the camera."""
    u = camera.center_u - camera.focal_px * left / ahead
    return np.stack([u, camera.center_v - camera.focal_px * up / ahead], axis=-1)


_PARALLEL = 1e-12  # a ray with a smaller component along an axis meets no plane across it


def cast_rays(
    camera: Pinhole, solids: Solids, bodies: list[ProjectedRobot], grey: Float, depth_m: np.ndarray,
    picture: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Draw robots into pixels whose centres hit them in front of the present depth.

    Args:
        camera: level camera.
        solids: solids of one robot.
        bodies: robots.
        grey: grey levels of the solids, shape (S,).
        depth_m: depths, infinity for background, shape (H, W); changed.
        picture: image, shape (H, W); changed.
    """
    for body in bodies:
        for i in body.shown.tolist():
            nearness = _nearness(camera, solids, i, body)
            top, bottom, left, right = body.windows[i].tolist()
            behind_m = depth_m[top : bottom + 1, left : right + 1]
            with np.errstate(invalid="ignore"):  # zero times infinity
                is_nearer = nearness * behind_m > 1
            behind_m[is_nearer] = 1 / nearness[is_nearer]
            if picture is not None:
                picture[top : bottom + 1, left : right + 1][is_nearer] = grey[i]


def _nearness(camera: Pinhole, solids: Solids, i: int, body: ProjectedRobot) -> Float:
    """Return the inverse depth of a solid at the pixels of its window; 0 beside the solid.

    Inverse depth is linear in the image for each plane. The surface is the farthest plane that
    faces the camera, if the ray has not left the solid before (Kay and Kajiya 1986).
    """
    top, bottom, left, right = body.windows[i].tolist()
    planes, f = slice(*solids.first_plane[i : i + 2]), camera.focal_px
    up = (camera.center_v - np.arange(top, bottom + 1)) / f

    def least(edges: Float, faces: np.ndarray, sign: float) -> Float:
        n, outside_m = solids.planes[planes, :3][faces], body.outside_m[planes][faces]
        ahead, aside, above = -sign * (body.axes @ n.T) / outside_m
        in_row = ahead + aside * ((camera.center_u - left) / f) + above * up[:, None]
        found = np.zeros((len(up), right + 1 - left))
        fill_minimum(edges, in_row, -aside / f, found)
        return found

    facing = body.outside_m[planes] > 0
    if not body.is_cut[i]:
        return least(body.outline(i), facing, 1.0)
    # a solid that reaches the near plane has no outline: rays through all pixels of the window
    around = np.array(
        [[-1.0, -1, -1, len(up)], [right + 1.0 - left, len(up), right + 1 - left, -1]]
    )
    nearness = np.minimum(least(around, facing, 1.0), 1 / camera.near_m)
    leaves = -least(around, body.outside_m[planes] < 0, -1.0)
    return np.where(nearness > np.maximum(leaves, 0.0), nearness, 0.0)


def draw_robots(
    camera: Pinhole, visible_walls: VisibleWalls, solids: Solids, bodies: list[ProjectedRobot],
    grey: Float, picture: np.ndarray,
) -> None:  # fmt: skip
    """Draw robots over an image, each pixel by the covered share.

    Args:
        camera: level camera.
        visible_walls: visible walls.
        solids: solids of one robot.
        bodies: visible robots, from the nearest to the farthest.
        grey: grey levels of the solids, shape (S,).
        picture: image, shape (H, W) uint8; changed.
    """
    bounds = np.array([body.bounds() for body in bodies])
    (above, first), (below, last) = bounds[:, ::2].min(axis=0), bounds[:, 1::2].max(axis=0)
    under = picture[above:below, first:last].astype(np.float32)
    seen, rest = under.copy(), np.ones_like(under)
    for body in bodies:
        open_share = _open_shares(camera, visible_walls, solids, body, first, last)
        windows = body.windows.tolist()
        for i in front_to_back(solids, body.eye_m):
            top, bottom, left, right = windows[i]
            if top > bottom or left > right:
                continue
            if body.is_cut[i]:  # by pixel centres
                covered = (_nearness(camera, solids, i, body) > 0).astype(np.float64)
            else:
                covered = np.zeros((bottom + 1 - top, right + 1 - left))
                fill_coverage(body.outline(i), covered)
            columns = slice(left - first, right + 1 - first)
            window = slice(top - above, bottom + 1 - above), columns
            # within a pixel, nearer solids take their share first
            coverage = np.minimum(covered * open_share[i, columns], rest[window])
            rest[window] -= coverage
            seen[window] += coverage * (grey[i] - under[window])
    picture[above:below, first:last] = (seen + 0.5).astype(np.uint8)


def _open_shares(
    camera: Pinhole,
    visible_walls: VisibleWalls,
    solids: Solids,
    body: ProjectedRobot,
    first: int,
    last: int,
) -> Float:
    """Return shares (S, N) of columns `first` to `last` - 1 in which no wall hides a solid."""
    w = inverse_depths(visible_walls, first, last)
    if body.farthest_m * w.max() < 1:  # in front of all walls
        return np.ones((len(body.windows), last - first))
    (ahead_x, ahead_y), (left_x, left_y) = body.axes[:2, :2].tolist()
    low, high = solids.low_m[:, :2] - body.eye_m[:2], solids.high_m[:, :2] - body.eye_m[:2]
    x = np.stack([low[:, 0], low[:, 0], high[:, 0], high[:, 0]])
    y = np.stack([low[:, 1], high[:, 1], low[:, 1], high[:, 1]])
    corner_m, aside_m = ahead_x * x + ahead_y * y, left_x * x + left_y * y
    left = (camera.center_u - np.arange(first, last)) / camera.focal_px
    # depths at which columns meet the bounding boxes in plan, else of the nearest corners
    enter, leave = np.zeros((len(low), 1)), np.full((len(low), 1), np.inf)
    for axis, ray in enumerate((ahead_x + left * left_x, ahead_y + left * left_y)):
        ray[np.abs(ray) <= _PARALLEL] = np.nan  # ignored by fmin and fmax
        at_low, at_high = low[:, axis, None] / ray, high[:, axis, None] / ray
        enter = np.fmax(enter, np.minimum(at_low, at_high))
        leave = np.fmin(leave, np.maximum(at_low, at_high))
    distance = np.abs(aside_m[:, :, None] - left * corner_m[:, :, None])
    distance /= np.maximum(corner_m, camera.near_m)[:, :, None]
    nearest_m = np.take_along_axis(corner_m.T, np.argmin(distance, axis=0), axis=1)
    depth_m = np.where(enter <= leave, (enter + leave) / 2, nearest_m)
    begins = visible_walls.first[first : last + 1]
    width = (visible_walls.high - visible_walls.low)[begins[0] : begins[-1]]
    open_width = np.where(np.repeat(depth_m, np.diff(begins), axis=1) * w < 1, width, 0.0)
    return np.add.reduceat(open_width, begins[:-1] - begins[0], axis=1)
