"""Tests of `experiments.evaluation.run_plan`."""

from pathlib import Path

import pytest

from experiments.evaluation import tables
from experiments.evaluation.run_plan import plan_run
from experiments.pipeline.stage import Stage
from experiments.pipeline.stages.drive import drive_robots
from experiments.pipeline.stages.pipeline import build_pipeline
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


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "robots.0.start=[0.2, 1.2, 0]",
            r"robots\.0\.start: robot R1: start \(0\.20, 1\.20\), moved to .* by the start jitter",
        ),
        ("robots.1.route=[[7, 1]]", r"robots\.1\.route\.0: robot R2: waypoint 1 .* outside"),
        (
            "world.walls=[{points: [[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]]}, "
            "{points: [[3, 0], [3, 4]]}]",
            r"robots\.0\.route\.0: robot R1: the way from start .* leads through a wall",
        ),
        ("robots.1.start=[1.2, 1.3, 0]", r"robots\.0\.start and robots\.1\.start: .* apart"),
        ("drive.frame_interval_s=0.21", r"drive\.frame_interval_s is 0\.21: .* 1/60 s"),
        ("world.walls=[{points: [[0, 0], [0.01, 0]]}]", r"world\.walls\.0\.points: .* shorter"),
    ],
)
def test_a_plan_refuses_what_the_drive_refuses(
    tiny_path: Path, tmp_path: Path, override: str, message: str
) -> None:
    blocked = load_scenario(tiny_path, [override])
    with pytest.raises(InputError, match=f"^scenario tiny: {message}") as planned:
        plan_run(blocked, tmp_path, 1)
    (robot, *_) = build_pipeline(blocked).simulated
    driven = robot.features.before["drive"]
    assert isinstance(driven, Stage)
    with pytest.raises(InputError) as refused:
        drive_robots(driven.settings)
    assert str(planned.value) == f"scenario tiny: {refused.value}"
