"""Walls of one look: the same pictures in the same places, mirrored on a mirror image."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from mapfusion.geometry.numerics import Float
from sim.floorplan import FloorPlan, Wall, wall_shape
from sim.world import face_files, write_faces

L_SHAPED = np.array([[1.0, 1.0], [1.0, 2.2], [2.5, 2.2]])
ROOM = np.array([[0.0, 0.0], [12, 0], [12, 4], [0, 4], [0, 0]])
# Of the wall at L_SHAPED: beside it by 4 m and turned by half a turn; mirrored at x = 5; at y = x.
TURNED = [7.0, 4.0] - L_SHAPED
MIRRORED = [10.0, 0.0] + L_SHAPED * [-1, 1]


def pictures(folder: Path, *walls: Wall) -> list[tuple[Float, np.ndarray]]:
    """Corners (4, 3) and grey picture of each face but the outer room's."""
    plan = FloorPlan((Wall(ROOM), *walls))
    write_faces(folder, plan, np.random.default_rng(4))
    shown = []
    for i, face in enumerate(plan.faces()):
        on_a_wall = [np.abs(wall.points_m - face.corners_m[0, :2]).min() < 0.2 for wall in walls]
        if face.kind == "wall" and any(on_a_wall):
            picture = cv2.imread(str(face_files(folder, i)[1]), cv2.IMREAD_GRAYSCALE)
            assert picture is not None
            shown.append((face.corners_m, picture))
    return shown


def seen_from(shown: list[tuple[Float, np.ndarray]], place: Float) -> np.ndarray:
    """The picture at a point (3,) of a face's surface."""
    for corners, picture in shown:
        width, height = corners[1] - corners[0], corners[3] - corners[0]
        share = [float((place - corners[0]) @ side / (side @ side)) for side in (width, height)]
        normal = np.cross(width, height) / np.linalg.norm(np.cross(width, height))
        if abs((place - corners[0]) @ normal) < 1e-9 and min(share) > 0 and max(share) < 1:
            row = int((1 - share[1]) * picture.shape[0])
            return picture[row, int(share[0] * picture.shape[1])]
    raise AssertionError(f"no face at {place}")


@pytest.mark.parametrize("mirrored", [False, True])
def test_what_moves_with_a_wall_is_what_is_seen(mirrored: bool, tmp_path: Path) -> None:
    """Each point of the first wall's surface looks as its image under the motion, or mirroring."""
    other = Wall(MIRRORED if mirrored else TURNED, look="l", mirrored=mirrored)
    shown = pictures(tmp_path, Wall(L_SHAPED, look="l"), other)
    sign, offset = ([-1, 1], [10, 0]) if mirrored else ([-1, -1], [7, 4])
    rng = np.random.default_rng(0)
    same = []
    for _ in range(200):
        corners, _ = shown[rng.integers(len(shown) // 2)]
        along, up = rng.uniform(0.05, 0.95, 2)
        place = corners[0] + along * (corners[1] - corners[0]) + up * (corners[3] - corners[0])
        moved = np.array([*(place[:2] * sign + offset), place[2]])
        same.append(abs(int(seen_from(shown, place)) - int(seen_from(shown, moved))))
    assert len(shown) == 2 * (4 + 2)  # two sides of two segments, two ends
    assert np.mean(np.array(same) < 10) > 0.97  # of neighbouring texels where rounding says so


def test_without_a_look_no_two_are_alike(tmp_path: Path) -> None:
    shown = pictures(tmp_path, Wall(L_SHAPED), Wall(TURNED))
    grey = [picture[:, :20] for _, picture in shown]  # an end's is 25 wide
    same = [np.mean(a == b) for a, b in zip(grey[:6], grey[6:], strict=True)]
    assert max(same) < 0.5


def test_walls_without_a_look_are_painted_as_they_were_before_others_had_one(
    tmp_path: Path,
) -> None:
    plain = pictures(tmp_path / "plain", Wall(L_SHAPED), Wall(TURNED))
    looks = pictures(tmp_path / "looks", Wall(L_SHAPED), Wall(TURNED, look="alone"))
    for (_, before), (_, after) in zip(plain, looks, strict=True):
        np.testing.assert_array_equal(before, after)


def test_the_shape_is_that_of_congruent_lines() -> None:
    shape = wall_shape(L_SHAPED, mirrored=False)
    np.testing.assert_allclose(shape, [1.2, 1.5, -np.pi / 2])
    np.testing.assert_allclose(wall_shape(TURNED, mirrored=False), shape, atol=1e-12)
    np.testing.assert_allclose(wall_shape(MIRRORED, mirrored=True), shape, atol=1e-12)
    assert not np.allclose(wall_shape(MIRRORED, mirrored=False), shape)
