"""The first pictures wait for a drive of the first frames alone, and are the same."""

from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation.evaluated_run import JudgedRun
from experiments.pipeline.head_start import head_start, with_head_start
from experiments.pipeline.pipeline import lay_out
from experiments.pipeline.stage import Job
from experiments.pipeline.stages import drive
from experiments.pipeline.stages.features import FRAMES_PER_CHUNK
from experiments.pipeline.store import Store
from experiments.pipeline.tasks import unfinished
from experiments.scenario.settings import Simulation
from sim.trajectory import read_trajectory


def long(scenario: Simulation, frames: int, renderer: str = "raycast") -> Simulation:
    """The scenario, driven for so many frames, by bodies that sway."""
    settings = scenario.resolved()
    settings["drive"] |= {"frames": frames, "body_sway": {"sigma_rad": 0.02}}
    settings["render"]["renderer"] = renderer
    return Simulation.model_validate(settings)


def test_robots_begin_as_they_do_on_the_whole_way(tiny: Simulation, tmp_path: Path) -> None:
    pipeline = lay_out(long(tiny, 44))
    head, whole = head_start(pipeline), pipeline.simulated[0].features.before["drive"]
    assert head is not None
    ways = []
    for stage in (head, whole):
        folder = tmp_path / stage.key
        folder.mkdir()
        drive.run(stage.settings, Job({}, folder))  # pyright: ignore
        ways.append(read_trajectory(folder / drive.TRAJECTORY_FILE))
    few, all_frames = ways
    assert (len(few), len(all_frames)) == (FRAMES_PER_CHUNK, 44)
    assert np.ptp(few.tilt_rad) > 0
    for name in ("T_world_robot", "wheel_rad", "tilt_rad"):
        first = getattr(all_frames, name)[:, : len(few)]
        np.testing.assert_array_equal(getattr(few, name), first)
    np.testing.assert_array_equal(few.time_s, all_frames.time_s[: len(few)])


@pytest.mark.parametrize(("renderer", "n_early"), [("raycast", 4), ("tiny", 1)])
def test_first_pictures_wait_for_their_own_drive(
    tiny: Simulation, tmp_path: Path, renderer: str, n_early: int
) -> None:
    run = JudgedRun.of(long(tiny, 480, renderer), Store.of(tmp_path))
    head, left = head_start(run.pipeline), list(run.tasks.values())
    assert head is not None
    tasks = {task.name: task for task in with_head_start(run.pipeline, run.store, left)}
    assert next(iter(tasks)) == f"drive/{head.key}"
    assert list(tasks)[1:] == [task.name for task in left]
    whole = {name for name in tasks if name.startswith("drive/")} - {f"drive/{head.key}"}
    for robot in run.pipeline.simulated:
        for k, part in enumerate(robot.features.parts):
            task = tasks[f"features/{robot.features.key}/{part}"]
            wanted, other = ({f"drive/{head.key}"}, whole)[:: 1 if k < n_early else -1]
            assert wanted <= set(task.needs)
            assert other.isdisjoint(task.needs)
            (folder,) = {run.store.root / name for name in wanted}
            assert task.arguments[2].inputs["drive"] == folder
            assert task.outputs == run.tasks[task.name].outputs
    others = [name for name in tasks if not name.startswith(("drive/", "features/"))]
    assert all(tasks[name] is run.tasks[name] for name in others)


def test_without_a_drive_to_wait_for_all_stays_as_it_is(tiny: Simulation, tmp_path: Path) -> None:
    assert head_start(lay_out(long(tiny, 39))) is None  # hardly longer than a chunk
    run = JudgedRun.of(long(tiny, 480), Store.of(tmp_path))
    goals = list(run.tasks)[1:]
    left = [task for task in unfinished(run.tasks, goals) if not task.name.startswith("drive/")]
    assert with_head_start(run.pipeline, run.store, left) == left
