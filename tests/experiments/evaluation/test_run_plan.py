"""Tests of `experiments.evaluation.run_plan`."""

from pathlib import Path

import pytest

from experiments.evaluation import tables
from experiments.evaluation.run_plan import plan_run
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from mapfusion.errors import InputError


def test_a_run_is_estimated_to_take_what_it_took(tiny: Simulation, tiny_results: Path) -> None:
    plan = plan_run(tiny, tiny_results, 1, fresh=True)
    timings = tables.read(tables.table_path(tiny_results / "tiny-3", "timings"), "timings")
    took_s = tables.work_by_stage(timings).set_index("stage")["seconds"]
    assert plan.n_earlier == 1
    for stage in plan.stages:
        assert stage.work_s == pytest.approx(took_s[stage.name]), stage.name
        assert stage.finished == 0
    assert plan.elapsed_s == pytest.approx(plan.work_s)  # one process
    assert plan.n_frames == {"R1": 44, "R2": 44}


def test_finished_stages_take_no_time(tiny: Simulation, tiny_results: Path) -> None:
    plan = plan_run(tiny, tiny_results, 2)
    assert sum(stage.to_do for stage in plan.stages) == 0
    assert sum(stage.work_s for stage in plan.stages) == 0
    assert plan.work_s > 0  # tables and figures


def test_work_grows_with_frames_and_processes_share_it(tiny_path: Path, tmp_path: Path) -> None:
    short, long = (load_scenario(tiny_path, [f"drive.frames={n}"]) for n in (40, 400))
    first, second = (plan_run(each, tmp_path, 1) for each in (short, long))
    assert first.n_earlier == 0
    ratios = {
        a.name: b.work_s / a.work_s
        for a, b in zip(first.stages, second.stages, strict=True)
        if a.name not in ("faces",)
    }
    assert all(ratio == pytest.approx(10) for ratio in ratios.values()), ratios
    shared = plan_run(long, tmp_path, 2)
    assert shared.work_s == pytest.approx(second.work_s)
    assert second.elapsed_s / 2 < shared.elapsed_s < second.elapsed_s
    assert list(tmp_path.iterdir()) == []


def test_too_much_memory_is_refused(tiny_path: Path, tmp_path: Path) -> None:
    greedy = load_scenario(tiny_path, ["slam.filter.n_particles=10000"])
    with pytest.raises(InputError, match="machine has"):
        plan_run(greedy, tmp_path, 4000)
