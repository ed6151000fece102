import json
from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation import tables
from experiments.reports.figures.map_figures import classify_correspondences
from experiments.reports.figures.result_tables import ResultTables
from mapfusion.errors import InputError
from mapfusion.files import DIGEST

PAIR = ("R1", "R2")
ALIGNERS = ["ransac", "svd", "icp", "impicp"]
TRUE_PAIR_RADIUS_M = 0.10


def test_names_come_in_display_order(trio_result: Path) -> None:
    data = ResultTables(trio_result)
    assert data.robots == ["R1", "R2", "R3"]
    assert data.pairs == [("R1", "R2"), ("R1", "R3"), ("R2", "R3")]
    assert data.aligners == [*ALIGNERS, "oracle"]


def test_order_of_aligners_is_the_scenarios(trio_result: Path) -> None:
    scenario = json.loads((trio_result / "scenario.json").read_text())
    names = [entry["name"] for entry in scenario["align"]["aligners"]]
    assert names == ALIGNERS
    assert names != sorted(names)
    assert ResultTables(trio_result).aligners == [*names, "oracle"]


@pytest.mark.parametrize(
    ("name", "asked"), [("tables/errors.parquet", "aligners"), ("scenario.json", "scenario")]
)
def test_missing_and_damaged_files_are_named(name: str, asked: str, trio_copy: Path) -> None:
    (trio_copy / name).write_text("not what it should be")
    with pytest.raises(InputError, match=name.rpartition("/")[2]):
        getattr(ResultTables(trio_copy), asked)
    (trio_copy / name).unlink()
    with pytest.raises(InputError, match=f"{name.rpartition('/')[2]}: no such file"):
        getattr(ResultTables(trio_copy), asked)


def test_walls_are_moved_into_the_robots_frame(trio_result: Path) -> None:
    data = ResultTables(trio_result)
    world = json.loads((trio_result / "world.json").read_text())
    x, y, theta = world["robots"]["R3"]
    back = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    for wall, moved in zip(world["faces"], data.walls_in_frame_of("R3"), strict=True):
        np.testing.assert_allclose(moved @ back.T + [x, y], wall, atol=1e-12)


def test_walls_are_drawn_where_their_faces_stand(trio_copy: Path) -> None:
    """Half of the wall's thickness off its middle line: there is where the landmarks are."""
    inner, outer = sorted(ResultTables(trio_copy).walls, key=np.ptp)
    room = np.array([[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]])
    outward = np.sign(room - [3, 2])
    np.testing.assert_allclose(inner, room - 0.06 * outward, atol=1e-9)
    np.testing.assert_allclose(outer, room + 0.06 * outward, atol=1e-9)
    world = json.loads((trio_copy / "world.json").read_text())
    del world["faces"], world[DIGEST]  # as results were before
    (trio_copy / "world.json").write_text(json.dumps(world))
    np.testing.assert_array_equal(ResultTables(trio_copy).walls, [room])


def test_without_a_world_there_are_no_walls_and_no_truth(trio_copy: Path) -> None:
    (trio_copy / "world.json").unlink()
    data = ResultTables(trio_copy)
    assert data.walls_in_frame_of("R1") == []
    assert data.true_alignment(PAIR) is None


def test_correspondences_of_an_earlier_iteration_are_never_taken_for_the_last(
    trio_copy: Path,
) -> None:
    """Their rows point into maps that are not stored: the wrong landmarks would be joined."""
    path = tables.table_path(trio_copy, "correspondences")
    rows = tables.read(path, "correspondences")
    last = ResultTables(trio_copy).last_iteration(PAIR)
    of_pair = (rows["robot_a"] == PAIR[0]) & (rows["robot_b"] == PAIR[1])
    tables.write(path, "correspondences", rows[~(of_pair & (rows["iteration"] == last))])
    assert ResultTables(trio_copy).last_correspondences(PAIR).empty


def test_correspondences_are_judged_by_the_truth(trio_result: Path) -> None:
    """True where both landmarks' true points, moved into the world, are one and the same."""
    data = ResultTables(trio_result)
    landmarks = data.table("landmarks").set_index(["robot", "landmark"])
    world = json.loads((trio_result / "world.json").read_text())

    def in_world(robot: str, landmark: int) -> np.ndarray:
        x, y, theta = world["robots"][robot]
        own = landmarks.loc[(robot, landmark), ["truth_x_m", "truth_y_m", "truth_z_m"]].tolist()
        c, s = np.cos(theta), np.sin(theta)
        return np.array([x + c * own[0] - s * own[1], y + s * own[0] + c * own[1], own[2]])

    right, names = classify_correspondences(data, PAIR)
    assert names[0] == "true correspondences"
    rows = data.last_correspondences(PAIR)
    expected = [
        np.linalg.norm(in_world(PAIR[0], a) - in_world(PAIR[1], b)) <= TRUE_PAIR_RADIUS_M
        for a, b in zip(rows["index_a"], rows["index_b"], strict=True)
    ]
    assert right.tolist() == expected
    assert 0 < sum(expected) < len(expected)


def test_without_the_truth_they_are_judged_by_the_first_aligners_inliers(trio_copy: Path) -> None:
    (trio_copy / "world.json").unlink()
    data = ResultTables(trio_copy)
    right, names = classify_correspondences(data, PAIR)
    estimates = data.table("estimates")
    chosen = (estimates["robot_a"] == PAIR[0]) & (estimates["robot_b"] == PAIR[1])
    chosen &= (estimates["iteration"] == data.last_iteration(PAIR)) & (estimates["repetition"] == 0)
    packed = estimates[chosen & (estimates["aligner"] == "ransac")]["refined_inliers"].iloc[0]
    bits = "".join(f"{byte:08b}" for byte in packed)
    assert names[0] == "ransac's refined inliers"
    assert "".join(str(int(bit)) for bit in right) == bits[: len(right)]
