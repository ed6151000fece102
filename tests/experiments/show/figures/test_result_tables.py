import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from experiments.judge import tables
from experiments.show.figures.fig07_correspondences import judge_correspondences
from experiments.show.figures.result_tables import ResultTables
from mapfusion.errors import InputError
from tests.helpers.synthetic_result import ALIGNERS

PAIR = ("R1", "R2")


@pytest.fixture
def copied(made_up_result: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made_up_result, tmp_path / "result"))


def test_names_come_in_display_order(made_up_result: Path) -> None:
    data = ResultTables(made_up_result)
    assert data.robots == ["R1", "R2", "R3"]
    assert data.pairs == [("R1", "R2"), ("R1", "R3"), ("R2", "R3")]
    assert data.aligners == [*ALIGNERS, "oracle"]


def test_order_of_aligners_is_the_scenarios(copied: Path) -> None:
    scenario = json.loads((copied / "scenario.json").read_text())
    scenario["align"]["aligners"].reverse()
    (copied / "scenario.json").write_text(json.dumps(scenario))
    assert ResultTables(copied).aligners == [*reversed(ALIGNERS), "oracle"]


@pytest.mark.parametrize("name", ["tables/errors.parquet", "scenario.json"])
def test_missing_and_damaged_files_are_named(name: str, copied: Path) -> None:
    (copied / name).write_text("not what it should be")
    with pytest.raises(InputError, match=name.rpartition("/")[2]):
        _ = ResultTables(copied).aligners
    (copied / name).unlink()
    with pytest.raises(InputError, match=f"{name.rpartition('/')[2]}: no such file"):
        _ = ResultTables(copied).aligners


def test_walls_are_moved_into_the_robots_frame(made_up_result: Path) -> None:
    data = ResultTables(made_up_result)
    world = json.loads((made_up_result / "world.json").read_text())
    x, y, theta = world["robots"]["R3"]
    back = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    for wall, moved in zip(world["walls"], data.walls_in_frame_of("R3"), strict=True):
        np.testing.assert_allclose(moved @ back.T + [x, y], wall, atol=1e-12)


def test_without_a_world_there_are_no_walls_and_no_truth(copied: Path) -> None:
    (copied / "world.json").unlink()
    data = ResultTables(copied)
    assert data.walls_in_frame_of("R1") == []
    assert data.true_alignment(PAIR) is None


def test_correspondences_of_an_earlier_iteration_are_never_taken_for_the_last(
    copied: Path,
) -> None:
    """Their rows point into maps that are not stored: the wrong landmarks would be joined."""
    path = tables.table_path(copied, "correspondences")
    rows = tables.read(path, "correspondences")
    last = ResultTables(copied).last_iteration(PAIR)
    of_pair = (rows["robot_a"] == PAIR[0]) & (rows["robot_b"] == PAIR[1])
    tables.write(path, "correspondences", rows[~(of_pair & (rows["iteration"] == last))])
    assert ResultTables(copied).last_correspondences(PAIR).empty


def test_correspondences_are_judged_by_the_truth(made_up_result: Path) -> None:
    """The writer puts the true ones first, and says how many they are."""
    data = ResultTables(made_up_result)
    right, names = judge_correspondences(data, PAIR)
    errors = data.table("errors")
    rows = (errors["robot_a"] == PAIR[0]) & (errors["robot_b"] == PAIR[1])
    n_true = int(errors[rows & (errors["iteration"] == data.last_iteration(PAIR))]["n_true"].max())
    assert names[0] == "true correspondences"
    assert right[:n_true].all()
    assert right[n_true:].sum() <= 2  # a random pair may hit the right landmark


def test_without_the_truth_they_are_judged_by_the_first_aligners_inliers(copied: Path) -> None:
    (copied / "world.json").unlink()
    data = ResultTables(copied)
    right, names = judge_correspondences(data, PAIR)
    estimates = data.table("estimates")
    chosen = (estimates["robot_a"] == PAIR[0]) & (estimates["robot_b"] == PAIR[1])
    chosen &= (estimates["iteration"] == data.last_iteration(PAIR)) & (estimates["repetition"] == 0)
    packed = estimates[chosen & (estimates["aligner"] == "ransac")]["refined_inliers"].iloc[0]
    bits = "".join(f"{byte:08b}" for byte in packed)
    assert names[0] == "ransac's refined inliers"
    assert "".join(str(int(bit)) for bit in right) == bits[: len(right)]
