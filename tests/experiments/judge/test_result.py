"""Whoever is told that a part of a result is written finds it there."""

import shutil
from pathlib import Path

from experiments.judge import tables
from experiments.judge.result import run_scenario
from experiments.scenario.settings import Simulation


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
