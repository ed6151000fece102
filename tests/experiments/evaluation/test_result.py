"""Contents of a result: a part is complete before it is announced."""

import shutil
from pathlib import Path

import numpy as np

from experiments.evaluation import tables
from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.result import run_scenario
from experiments.pipeline.stages.smooth import stored_maps
from experiments.pipeline.store import Store
from experiments.scenario.settings import Simulation
from mapfusion.landmark_map import read_map


def test_each_part_is_there_when_it_is_told(
    tiny: Simulation, tiny_results: Path, tmp_path: Path
) -> None:
    shutil.copytree(tiny_results, tmp_path, dirs_exist_ok=True)
    result = tmp_path / "tiny-3"
    earlier = {path: path.stat().st_mtime_ns for path in result.rglob("*.*")}
    told: list[str] = []

    def is_new(path: Path) -> bool:
        return path.stat().st_mtime_ns > earlier[path]

    def written(folder: Path, part: str) -> None:
        assert folder == result
        is_table = part != "scenario"
        assert is_new(tables.table_path(folder, part) if is_table else folder / "scenario.json")
        assert is_new(folder / "world.json")
        assert len(list((folder / "keyframes").iterdir())) == 4
        told.append(part)

    run_scenario(tiny, tmp_path, 1, lambda *_: None, on_written=written)
    files = [path.stem for path in (result / "tables").iterdir()]
    assert sorted(told) == sorted(["scenario", *files])


def test_maps_of_a_result_tell_from_where_their_landmarks_were_seen(
    tiny: Simulation, tiny_results: Path
) -> None:
    run = EvaluatedRun.of(tiny, Store.of(tiny_results))
    for robot in run.pipeline.robots:
        stored = stored_maps(run.robot_folders(robot), viewing=True)[robot.n_frames - 1].viewing
        told = read_map(tiny_results / "tiny-3" / "maps" / f"{robot.name}.parquet").viewing
        assert stored is not None
        assert told is not None
        np.testing.assert_array_equal(told.n_views, stored.n_views)
        np.testing.assert_array_equal(told.pose, stored.pose)
