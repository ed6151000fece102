"""The first frames driven apart, so that their pictures are drawn while the rest is driven.

All robots drive in one world, step by step, so one process drives and the others would have nothing
to do until it has come to the end. How the robots begin does not depend on how long they drive: the
first frames are driven for themselves once more.
"""

from collections.abc import Sequence
from dataclasses import replace

from experiments.pipeline.pipeline import Pipeline
from experiments.pipeline.stage import Stage
from experiments.pipeline.stages.features import FRAMES_PER_CHUNK
from experiments.pipeline.store import Store
from experiments.pipeline.tasks import Task, task_names, tasks_of
from experiments.scenario.settings import Simulation

# Of all frames: as many as the ray caster and the front end, which take four times as long for one
# as the drive does, are done with when the drive is over. Of slower renderers' pictures one chunk
# of each robot takes longer than the drive.
_SHARE = 1 / 6


def head_start(pipeline: Pipeline) -> Stage | None:
    """The drive of the first frames; None where nobody drives, or hardly longer than that."""
    scenario = pipeline.scenario
    if not isinstance(scenario, Simulation):
        return None
    share = _SHARE if scenario.render.renderer == "raycast" else 0
    n_chunks = max(round(share * scenario.drive.frames / FRAMES_PER_CHUNK), 1)
    frames = n_chunks * FRAMES_PER_CHUNK
    if 2 * frames > scenario.drive.frames:
        return None
    driven = _drive(pipeline)
    return replace(driven, settings=replace(driven.settings, frames=frames))


def with_head_start(pipeline: Pipeline, store: Store, left: Sequence[Task]) -> list[Task]:
    """The tasks that are left, if the drive is one: those of the first pictures wait for less."""
    head, names = head_start(pipeline), {task.name for task in left}
    if head is None or names.isdisjoint(task_names(_drive(pipeline))):
        return [*left]
    n_chunks = head.settings.frames // FRAMES_PER_CHUNK
    early = {name for robot in pipeline.simulated for name in task_names(robot.features)[:n_chunks]}
    waiting = [
        _moved(task, _drive(pipeline), head, store) if task.name in early else task for task in left
    ]
    return [*tasks_of([head], store).values(), *waiting]


def _drive(pipeline: Pipeline) -> Stage:
    driven = pipeline.simulated[0].features.before["drive"]
    assert isinstance(driven, Stage)
    return driven


def _moved(task: Task, before: Stage, after: Stage, store: Store) -> Task:
    """The same work from what another stage made."""
    work, settings, job, folder = task.arguments
    others = {store.path(before): store.path(after)}
    inputs = {name: others.get(path, path) for name, path in job.inputs.items()}
    needs = tuple(name for name in task.needs if name not in task_names(before))
    arguments = (work, settings, replace(job, inputs=inputs), folder)
    return replace(task, arguments=arguments, needs=(*task_names(after), *needs))
