"""The robots' bodies, read from the URDF that PyBullet loads: convex solids of one colour each."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from mapfusion.geometry.numerics import Float

MARGIN_M = 0.001  # by which PyBullet shows cylinders too large

_Hull = tuple[Float, np.ndarray, np.ndarray]  # planes, edges and sides, see `Solids`


class Solids(NamedTuple):
    """One robot at rest, in its own frame: metres, the floor at z = 0.

    Corners, faces and edges of all S solids one after the other; faces are triangles.

    Attributes:
        corners_m: (N, 3).
        first_corner: (S + 1,) int64, where each solid's begin, and N.
        planes: (P, 4) the faces' outward normals and offsets: inside, n p <= d.
        first_plane: (S + 1,) likewise.
        edges: (E, 2) int64 corners: the first face lies to the left of the way along an edge, seen
            from outside.
        sides: (E, 2) int64, the faces that meet there.
        first_edge: (S + 1,) likewise.
        low_m: (S, 3) lowest corners of the boxes around them.
        high_m: (S, 3) highest.
        rgb: (S, 3) float64 colours as they show, of 255.
        reach_m: no part is farther from where it stands, in plan.
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
    """What a URDF's links show: boxes and cylinders, their links where no joint has turned."""
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
    """Where each of the parts begins, one after the other, and where the last ends."""
    return np.cumsum([0, *(len(part) for part in parts)])


def _numbers(element: ElementTree.Element | None, name: str) -> Float:
    words = "0 0 0" if element is None else element.attrib.get(name, "0 0 0")
    return np.array([float(word) for word in words.split()])


def _named(element: ElementTree.Element, child: str, name: str = "link") -> str:
    found = element.find(child)
    assert found is not None
    return found.attrib[name]


def _shape(visual: ElementTree.Element, place_m: Float) -> tuple[Float, _Hull]:
    """Corners (K, 3) of a box or a cylinder in the robot's frame, and its faces."""
    origin, box = visual.find("origin"), visual.find("geometry/box")
    if box is not None:
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners = signs * _numbers(box, "size") / 2
    else:
        cylinder = visual.find("geometry/cylinder")
        assert cylinder is not None
        radius, half_m = float(cylinder.attrib["radius"]), float(cylinder.attrib["length"]) / 2
        corners = _bullets_cylinder(radius, half_m)
    planes, edges, sides = _hull(corners)
    R, at = _rotation(_numbers(origin, "rpy")), _numbers(origin, "xyz")
    planes[:, :3] = planes[:, :3] @ R.T
    planes[:, 3] += planes[:, :3] @ at
    planes[:, 3] += planes[:, :3] @ place_m
    return corners @ R.T + at + place_m, (planes, edges, sides)


def _hull(corners: Float) -> _Hull:
    """Planes, edges and the faces that meet there, see `Solids`, of the corners of a solid."""
    hull = ConvexHull(corners)
    a, b, c = np.moveaxis(corners[hull.simplices], 1, 0)
    normals = hull.equations[:, :3]
    turned = np.sum(np.cross(b - a, c - a) * normals, axis=1) < 0
    edges, sides = [], []
    for i, (corner, beside) in enumerate(zip(hull.simplices, hull.neighbors, strict=True)):
        for k in range(3):  # the edge across from corner k
            if i < beside[k]:
                way = [corner[(k + 1) % 3], corner[(k + 2) % 3]]
                edges.append(way[::-1] if turned[i] else way)
                sides.append([i, beside[k]])
    planes = hull.equations.round(9) * [1, 1, 1, -1]
    return planes, np.array(edges), np.array(sides)


def _bullets_cylinder(radius: float, half_m: float) -> Float:
    """Corners (42, 3) of what PyBullet shows for a cylinder along z.

    A prism of 32 sides, of which it keeps the farthest corners in 42 directions, each pushed out by
    a margin (`btShapeHull`): those to the corners and edges of an icosahedron.
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


def _rotation(rpy: ArrayLike) -> Float:
    """Roll, pitch and yaw about fixed axes, as URDF has them."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def front_to_back(solids: Solids, eye_m: Float) -> list[int]:
    """An order (S,) in which none hides one before it, seen from a point (3,) of their frame.

    The boxes around them do not overlap, so between any two lies a plane along two axes; what
    is on the eye's side of it cannot be hidden by the other.
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
