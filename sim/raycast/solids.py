"""The robots' bodies, read from the URDF that PyBullet loads: convex solids of one colour each."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from mapfusion.kernels import kernel_part
from mapfusion.se2 import Float

MARGIN_M = 0.001  # by which PyBullet shows cylinders too large


class Solids(NamedTuple):
    """One robot at rest, in its own frame: metres, the floor at z = 0.

    Attributes:
        corners_m: (S, K, 3) convex hulls' corners.
        n_corners: (S,) int64, how many of them count.
        planes: (S, P, 4) outward normals and offsets: inside, n p <= d.
        n_planes: (S,) int64, how many of them count.
        low_m: (S, 3) lowest corners of the boxes around them.
        high_m: (S, 3) highest.
        rgb: (S, 3) float64 colours as they show, of 255.
    """

    corners_m: Float
    n_corners: np.ndarray
    planes: Float
    n_planes: np.ndarray
    low_m: Float
    high_m: Float
    rgb: Float


def read_solids(urdf: Path) -> Solids:
    """What a URDF's links show: boxes and cylinders, their links where no joint has turned."""
    root = ElementTree.parse(urdf).getroot()  # noqa: S314 - a file of our own
    colours = {m.attrib["name"]: _numbers(m.find("color"), "rgba") for m in root.iter("material")
               if m.find("color") is not None}  # fmt: skip
    places = {_named(j, "child"): _numbers(j.find("origin"), "xyz") for j in root.iter("joint")}
    shapes = []
    for link in root.iter("link"):
        place = places.get(link.attrib["name"], np.zeros(3))
        for visual in link.iter("visual"):
            rgb = np.floor(255 * colours[_named(visual, "material", "name")][:3])
            corners_m, planes = _shape(visual)
            planes[:, 3] += planes[:, :3] @ place
            shapes.append((corners_m + place, planes, rgb))
    most = [max(len(shape[part]) for shape in shapes) for part in range(2)]
    corners_m, planes = np.zeros((len(shapes), most[0], 3)), np.zeros((len(shapes), most[1], 4))
    for i, (own_corners, own_planes, _) in enumerate(shapes):
        corners_m[i, : len(own_corners)] = own_corners
        planes[i, : len(own_planes)] = own_planes
    return Solids(
        corners_m,
        np.array([len(own) for own, _, _ in shapes]),
        planes,
        np.array([len(own) for _, own, _ in shapes]),
        np.array([own.min(axis=0) for own, _, _ in shapes]),
        np.array([own.max(axis=0) for own, _, _ in shapes]),
        np.array([rgb for _, _, rgb in shapes]),
    )


def _numbers(element: ElementTree.Element | None, name: str) -> Float:
    words = "0 0 0" if element is None else element.attrib.get(name, "0 0 0")
    return np.array([float(word) for word in words.split()])


def _named(element: ElementTree.Element, child: str, name: str = "link") -> str:
    found = element.find(child)
    assert found is not None
    return found.attrib[name]


def _shape(visual: ElementTree.Element) -> tuple[Float, Float]:
    """Corners (K, 3) and planes (P, 4) of a box or a cylinder in its link's frame."""
    origin, box = visual.find("origin"), visual.find("geometry/box")
    R = _rotation(_numbers(origin, "rpy"))
    if box is not None:
        half = _numbers(box, "size") / 2
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners, normals, offsets = (
            signs * half,
            np.vstack([np.eye(3), -np.eye(3)]),
            np.tile(half, 2),
        )
    else:
        cylinder = visual.find("geometry/cylinder")
        assert cylinder is not None
        radius, half_m = float(cylinder.attrib["radius"]), float(cylinder.attrib["length"]) / 2
        corners = _bullets_cylinder(radius, half_m)
        planes = np.unique(ConvexHull(corners).equations.round(9), axis=0)
        normals, offsets = planes[:, :3], -planes[:, 3]
    at = _numbers(origin, "xyz")
    normals = normals @ R.T
    return corners @ R.T + at, np.column_stack([normals, offsets + normals @ at])


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


@kernel_part
def front_to_back(solids: Solids, eye_m: Float) -> np.ndarray:
    """An order (S,) in which none hides one before it, seen from a point (3,) of their frame.

    The boxes around them do not overlap, so between any two lies a plane along two axes; what
    is on the eye's side of it cannot be hidden by the other.
    """
    n = len(solids.n_corners)
    order, taken = np.empty(n, dtype=np.int64), np.zeros(n, dtype=np.bool_)
    for place in range(n):
        order[place] = -1
        for i in range(n):
            if taken[i]:
                continue
            first = True
            for j in range(n):
                if j != i and not taken[j]:
                    first = first and _unhidden(solids, i, j, eye_m)
            if first or order[place] < 0:
                order[place] = i
            if first:
                break
        taken[order[place]] = True
    return order


@kernel_part
def _unhidden(solids: Solids, i: int, j: int, eye_m: Float) -> bool:
    """Whether solid j can hide nothing of solid i."""
    for axis in range(3):
        low, high = solids.low_m[:, axis], solids.high_m[:, axis]
        if high[i] <= low[j] + 1e-9 and eye_m[axis] <= low[j]:
            return True
        if low[i] >= high[j] - 1e-9 and eye_m[axis] >= high[j]:
            return True
    return False
