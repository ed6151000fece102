import numpy as np
import pytest

from mapfusion.errors import InputError
from sim.floorplan import FloorPlan, Wall


def dense_clearance(plan: FloorPlan, points: np.ndarray) -> np.ndarray:
    """Room to the walls, from points sampled along their middle lines."""
    starts, ends, thickness, _ = plan.segments()
    share = np.linspace(0, 1, 2001)[:, None]
    best = np.full(len(points), np.inf)
    for start, end, thick in zip(starts, ends, thickness, strict=True):
        on_wall = start + share * (end - start)
        distance = np.linalg.norm(points[:, None] - on_wall, axis=-1).min(axis=1)
        best = np.minimum(best, distance - thick / 2)
    return best


def test_clearance_agrees_with_dense_sampling(room: FloorPlan) -> None:
    points = np.random.default_rng(0).uniform([-1, -1], [6, 5], (200, 2))
    np.testing.assert_allclose(room.clearance_m(points), dense_clearance(room, points), atol=2e-3)
    assert room.clearance_m([[3.0, 0.7]])[0] == pytest.approx(-0.05)


def test_leg_clearance_agrees_with_dense_sampling(room: FloorPlan) -> None:
    rng = np.random.default_rng(1)
    for start, end in rng.uniform([0.2, 0.2], [4.8, 3.8], (100, 2, 2)):
        along = start + np.linspace(0, 1, 1001)[:, None] * (end - start)
        expected = max(-0.05, room.clearance_m(along).min())
        assert room.leg_clearance_m(start, end) == pytest.approx(expected, abs=5e-3)


def test_leg_through_wall_has_no_room_however_thin_the_wall() -> None:
    plan = FloorPlan((Wall(np.array([[0.0, -1], [0, 1]]), thickness_m=0.01), square(4.0)))
    assert plan.leg_clearance_m([-1, 0.1], [1, 0.1]) < 0


def square(half: float) -> Wall:
    return Wall(half * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]))


def test_sides_of_a_closed_wall_are_squares_half_the_thickness_away() -> None:
    wall = square(2.0)
    inner, outer = wall.side(left=True), wall.side(left=False)  # counter-clockwise: left is inside
    np.testing.assert_allclose(inner, wall.points_m * (1.95 / 2), atol=1e-12)
    np.testing.assert_allclose(outer, wall.points_m * (2.05 / 2), atol=1e-12)


def test_every_face_looks_away_from_its_wall(room: FloorPlan) -> None:
    walls = [face for face in room.faces() if face.kind == "wall"]
    assert len(walls) == 4 + 3  # the room's inner sides; the stub's sides and its free end
    for face in walls:
        if face.size_m[0] < 0.2:  # an end: clearance takes it as rounded
            np.testing.assert_allclose(face.corners_m[:, 1], 1.5)
            assert face.corners_m[0, 0] > face.corners_m[1, 0]  # seen from y > 1.5
            continue
        right, up = face.corners_m[1] - face.corners_m[0], face.corners_m[3] - face.corners_m[0]
        normal = np.cross(right, up)
        normal /= np.linalg.norm(normal)
        middle = face.corners_m.mean(axis=0)
        probe = np.stack([middle + 0.02 * normal, middle - 0.02 * normal])[:, :2]
        before, behind = room.clearance_m(probe)
        assert before == pytest.approx(0.02)
        assert behind == pytest.approx(-0.02)
        assert up[2] == 2.5


def test_no_two_faces_lie_in_one_another(room: FloorPlan) -> None:
    """Coplanar faces that overlap would flicker."""
    faces = room.faces()
    for i, first in enumerate(faces):
        for second in faces[i + 1 :]:
            a, b = (face.corners_m for face in (first, second))
            normal = np.cross(a[1] - a[0], a[3] - a[0])
            if np.abs((b - a[0]) @ normal).max() < 1e-9:
                overlap = np.minimum(a.max(0), b.max(0)) - np.maximum(a.min(0), b.min(0))
                assert np.sort(overlap)[1] < 1e-9  # at most an edge in common


def test_floor_and_ceiling_face_each_other(room: FloorPlan) -> None:
    floor, ceiling = room.faces()[-2:]
    for face, height, sign in ((floor, 0.0, 1), (ceiling, 2.5, -1)):
        right, up = face.corners_m[1] - face.corners_m[0], face.corners_m[3] - face.corners_m[0]
        assert np.sign(np.cross(right, up)[2]) == sign
        np.testing.assert_array_equal(face.corners_m[:, 2], height)
        assert face.size_m == (5.0, 4.0)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0, 0]], "at least two points"),
        ([[0, 0], [1, 0], [1, 0.05]], "shorter than the wall is thick"),
        ([[0, 0], [2, 0], [0, 0.1]], "sharper than 30 degrees"),
        ([[0, 0], [2, 0], [1, 1], [0.5, 1], [4, -4], [0, 0]], "sharper than 30 degrees"),
    ],
)
def test_impossible_walls_are_refused(points: list[list[float]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Wall(np.array(points, dtype=float))


def test_a_corner_at_the_closing_point_is_judged_too() -> None:
    with pytest.raises(InputError, match="sharper"):
        Wall(np.array([[0, 0], [4, 0.4], [4, -0.4], [0, 0]]))


def test_a_world_needs_an_area() -> None:
    with pytest.raises(InputError, match="no floor"):
        FloorPlan((Wall(np.array([[0.0, 0], [3, 0]])),))
    with pytest.raises(InputError, match="at least one"):
        FloorPlan(())
