"""Floor plan: walls in plan, their visible faces, and clearances beside them."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float, require_finite, require_shape

SHARPEST_CORNER_RAD = np.radians(30)  # sharper corners have a very long mitred outer edge
BURIED_M = 0.001  # an end this deep in another wall is hidden; larger than rounding errors


@dataclass(frozen=True)
class Wall:
    """Upright wall along a polyline, which is closed if the last point equals the first.

    Attributes:
        points_m: middle line, shape (K, 2), K >= 2.
        height_m: height above the floor.
        thickness_m: half of it lies on either side of the middle line.
        look: walls of the same look have the same shape and textures; empty: textures of its own.
        mirrored: True if it is the mirror image of the other walls of its look.
    """

    points_m: Float
    height_m: float = 2.5
    thickness_m: float = 0.1
    look: str = ""
    mirrored: bool = False

    def __post_init__(self) -> None:
        points = np.asarray(self.points_m, dtype=np.float64)
        object.__setattr__(self, "points_m", points)
        require_shape("points_m", points, (None, 2))
        require_finite("points_m", points)
        if len(points) < 2:
            raise InputError("wall: points_m needs at least two points")
        for name in ("height_m", "thickness_m"):
            if not getattr(self, name) > 0:
                raise InputError(f"wall: {name} is {getattr(self, name)}, must be above 0")
        steps = np.diff(points, axis=0)
        if np.any(np.hypot(*steps.T) < self.thickness_m):
            raise InputError(
                f"wall from {format_point(points[0])}: a segment is shorter than the wall is thick"
            )
        pairs = np.concatenate([steps, steps[:1]]) if self.closed else steps
        headings = np.unwrap(np.arctan2(pairs[:, 1], pairs[:, 0]))
        if np.any(np.abs(np.diff(headings)) > np.pi - SHARPEST_CORNER_RAD):
            raise InputError(
                f"wall from {format_point(points[0])}: a corner is sharper than "
                f"{np.degrees(SHARPEST_CORNER_RAD):.0f} degrees"
            )

    @property
    def closed(self) -> bool:
        """True if the polyline ends at its start."""
        return len(self.points_m) > 3 and bool(np.all(self.points_m[0] == self.points_m[-1]))

    def side(self, left: bool) -> Float:
        """Return the left or right edge in plan, shape (K, 2), mitred at the corners."""
        points = self.points_m
        directions = np.diff(points, axis=0)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        before = np.concatenate([directions[-1:] if self.closed else directions[:1], directions])
        after = np.concatenate([directions, directions[:1] if self.closed else directions[-1:]])
        normals = np.stack([-(before + after)[:, 1], (before + after)[:, 0]], -1)
        # mitre length: half the thickness over the cosine of half the turn
        normals *= 2 / np.sum(normals**2, axis=1, keepdims=True)
        return points + (0.5 if left else -0.5) * self.thickness_m * normals

    def outline(self) -> list[Float]:
        """Return the faces in plan: closed lines, shape (n, 2); two for a closed wall."""
        left, right = self.side(left=True), self.side(left=False)
        if self.closed:
            return [left, right]
        return [np.concatenate([left, right[::-1], left[:1]])]


@dataclass(frozen=True)
class Face:
    """Flat rectangle of the world, visible from its front only.

    Attributes:
        corners_m: corners, shape (4, 3), counter-clockwise from the lower left, seen from the
            front.
        kind: "wall", "floor" or "ceiling".
        look: faces of the same look have the same texture; empty: a texture of its own.
        mirrored: True if the texture is mirrored left to right.
    """

    corners_m: Float
    kind: str
    look: str = ""
    mirrored: bool = False

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the face."""
        first, second, _, last = self.corners_m
        return float(np.linalg.norm(second - first)), float(np.linalg.norm(last - first))


@dataclass(frozen=True)
class FloorPlan:
    """Static world: walls, floor and ceiling.

    Floor and ceiling are the smallest axis-aligned rectangle around the walls' middle lines.

    Attributes:
        walls: one or more walls.
        ceiling: True if there is a ceiling, at the height of the highest wall.
    """

    walls: tuple[Wall, ...]
    ceiling: bool = True

    def __post_init__(self) -> None:
        if not self.walls:
            raise InputError("walls: at least one is needed")
        low, high = self.extent_m
        if np.any(high - low <= 0):
            raise InputError("walls: they span no area, so there would be no floor")

    @property
    def extent_m(self) -> tuple[Float, Float]:
        """Lowest and highest corner of the floor, shape (2,) each."""
        points = np.concatenate([wall.points_m for wall in self.walls])
        return points.min(axis=0), points.max(axis=0)

    @property
    def ceiling_m(self) -> float:
        """Height of the highest wall."""
        return max(wall.height_m for wall in self.walls)

    def segments(self) -> tuple[Float, Float, Float, Float]:
        """Return all segments: starts (S, 2), ends (S, 2), thickness (S,) and height (S,)."""
        starts = np.concatenate([wall.points_m[:-1] for wall in self.walls])
        ends = np.concatenate([wall.points_m[1:] for wall in self.walls])
        counts = [len(wall.points_m) - 1 for wall in self.walls]
        thickness = np.repeat([wall.thickness_m for wall in self.walls], counts)
        height = np.repeat([wall.height_m for wall in self.walls], counts)
        return starts, ends, thickness, height

    def clearance_m(self, points: ArrayLike) -> Float:
        """Return the distances (N,) from points (N, 2) to the nearest wall, negative inside.

        Free ends of walls count as rounded, so the result is slightly too small there.
        """
        points = np.asarray(points, dtype=np.float64)
        starts, ends, thickness, _ = self.segments()
        distance = segment_distance_m(points[:, None], starts[None], ends[None])
        return np.min(distance - thickness / 2, axis=1)

    def leg_clearance_m(self, start: ArrayLike, end: ArrayLike) -> float:
        """Return the distance between a leg from `start` to `end` and the nearest wall."""
        start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        starts, ends, thickness, _ = self.segments()
        distance = np.min(
            [
                segment_distance_m(start, starts, ends),
                segment_distance_m(end, starts, ends),
                segment_distance_m(starts, start, end),
                segment_distance_m(ends, start, end),
            ],
            axis=0,
        )
        # segments that properly cross the leg: the ends of each lie on both sides of the other
        crosses = (_side(start, end, starts) * _side(start, end, ends) < 0) & (
            _side(starts, ends, start) * _side(starts, ends, end) < 0
        )
        distance[crosses] = 0.0
        return float(np.min(distance - thickness / 2))

    def contains(self, points: ArrayLike) -> np.ndarray:
        """Return a mask (N,): True for points (N, 2) on the floor."""
        low, high = self.extent_m
        return np.all((np.asarray(points) >= low) & (np.asarray(points) <= high), axis=-1)

    def faces(self) -> list[Face]:
        """Return all faces that are visible inside: walls, then floor, then ceiling."""
        faces = list[Face]()
        for wall in self.walls:
            left, right = wall.side(left=True), wall.side(left=False)
            # the left side of a wall is the right side of its mirror image
            on_left, on_right = ("right", "left") if wall.mirrored else ("left", "right")
            # seen from the left side the wall runs from right to left
            edges = [(f"{on_left} {i}", left[i + 1], left[i]) for i in range(len(left) - 1)]
            edges += [(f"{on_right} {i}", right[i], right[i + 1]) for i in range(len(right) - 1)]
            # faces beyond the floor's edge and ends inside another wall are never visible
            edges = [edge for edge in edges if np.all(self.contains(np.stack(edge[1:])))]
            if not wall.closed:
                ends = [("first end", left[0], right[0]), ("last end", right[-1], left[-1])]
                bare = [np.any(self.clearance_m(np.stack(end[1:])) > -BURIED_M) for end in ends]
                edges += itertools.compress(ends, bare)
            for name, start, end in edges:
                corners = np.zeros((4, 3))
                corners[:, :2] = [start, end, end, start]
                corners[2:, 2] = wall.height_m
                look = f"{wall.look} {name}" if wall.look else ""
                faces.append(Face(corners, "wall", look, wall.mirrored))
        (x0, y0), (x1, y1) = self.extent_m
        plan = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        faces.append(Face(np.column_stack([plan, np.zeros(4)]), "floor"))
        if self.ceiling:
            seen_from_below = plan[[1, 0, 3, 2]]
            faces.append(
                Face(np.column_stack([seen_from_below, np.full(4, self.ceiling_m)]), "ceiling")
            )
        return faces


def wall_shape(points_m: Float, mirrored: bool) -> Float:
    """Return lengths (m) and turns (rad) of a polyline (K, 2), from its first point on.

    Congruent polylines have equal values. Turns of a mirrored polyline change their sign.
    """
    steps = np.diff(points_m, axis=0)
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    turns = np.angle(np.exp(1j * np.diff(headings)))
    return np.concatenate([np.hypot(*steps.T), -turns if mirrored else turns])


def segment_distance_m(points: Float, starts: Float, ends: Float) -> Float:
    """Return the distances of points (..., 2) to segments (..., 2), broadcast."""
    direction = ends - starts
    fraction = np.sum((points - starts) * direction, -1) / np.maximum(
        np.sum(direction**2, -1), 1e-300
    )
    nearest = starts + np.clip(fraction, 0, 1)[..., None] * direction
    return np.linalg.norm(points - nearest, axis=-1)


def _side(a: Float, b: Float, c: Float) -> Float:
    """Return the side of the line a-b on which c lies: 1 left, -1 right, 0 on the line."""
    ab, ac = b - a, c - a
    return np.sign(ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0])


def format_point(point: ArrayLike) -> str:
    """Return a point (2,) or pose (3,) as text `(x, y)` in metres."""
    x, y = np.asarray(point)[:2]
    return f"({x:.2f}, {y:.2f})"
