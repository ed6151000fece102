"""Stages as tasks: what to call, what must be done before, which files tell that it was done.

`mapfusion run` gives them to processes of its own, `mapfusion sweep` to a Dask cluster.
"""

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.pipeline.stage import Job, RecordedLog, Stage
from experiments.pipeline.store import StageFolder, Store, require_undamaged
from experiments.pipeline.workers import Workers
from mapfusion.files import remove_abandoned

OnProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Task:
    """One piece of work. It gives nothing back: all that it makes goes to files.

    Attributes:
        name: STAGE/KEY or STAGE/KEY/PART; tasks of the same name do the same work.
        label: what progress counts it under.
        function: called with the arguments.
        arguments: all can be pickled.
        outputs: files that are there once it is done; without any it is never taken for done.
        needs: names of the tasks that must be done before.
        shares: a name for what it keeps in memory; tasks of one name are given to one process, as
            far as they are ready together. Empty for none.
    """

    name: str
    label: str
    function: Callable[..., object]
    arguments: tuple[Any, ...]
    outputs: tuple[Path, ...]
    needs: tuple[str, ...] = ()
    shares: str = ""

    @property
    def finished(self) -> bool:
        """Whether all it makes is on disk."""
        return bool(self.outputs) and all(path.is_file() for path in self.outputs)

    def run(self) -> None:
        """Do the work, unless somebody else has done it meanwhile."""
        if not self.finished:
            self.function(*self.arguments)


def tasks_of(stages: Iterable[Stage], store: Store) -> dict[str, Task]:
    """The tasks of stages by name, each after those it needs.

    Neighbours with the same parts go part by part: two processes are then at different stages,
    and compile different kernels.
    """
    tasks = {}
    for parts, group in itertools.groupby(stages, key=lambda stage: stage.parts):
        folders = [(stage, store.folder(stage)) for stage in group]
        for part, (stage, folder) in itertools.product(parts, folders):
            task = _task(stage, part, folder, store)
            tasks[task.name] = task
    return tasks


def task_names(stage: Stage | RecordedLog) -> list[str]:
    """Names of the tasks that make a stage; none for what was there before."""
    return [] if isinstance(stage, RecordedLog) else [_name(stage, part) for part in stage.parts]


def _name(stage: Stage, part: str) -> str:
    return f"{stage.name}/{stage.key}" + (f"/{part}" if part else "")


def _task(stage: Stage, part: str, folder: StageFolder, store: Store) -> Task:
    needs: list[str] = []
    for before in stage.before.values():
        if isinstance(before, Stage) and before.parts == stage.parts:
            needs.append(_name(before, part))
        else:
            needs += task_names(before)
    inputs = {name: store.path(before) for name, before in stage.before.items()}
    arguments = (stage.work, stage.settings, Job(inputs, folder.path, part), folder)
    outputs = folder.outputs[part]
    shares = f"{stage.shares}/{part}" if stage.shares else ""
    return Task(_name(stage, part), stage.label, _perform, arguments, outputs, tuple(needs), shares)


def _perform(work: Callable[..., Any], settings: Any, job: Job, folder: StageFolder) -> None:
    """Make a part of a stage from inputs that are sound, and mark it as finished."""
    for stage in job.inputs.values():
        require_undamaged(stage)
    remove_abandoned(folder.path)  # by a process that was killed while it made the same
    started = time.perf_counter()
    figures = dict(work(settings, job) or {})
    folder.finish(job.part, {"elapsed_s": time.perf_counter() - started} | figures)


def unfinished(tasks: dict[str, Task], goals: Iterable[str]) -> list[Task]:
    """The tasks left to do for the outputs of those named, in the order of `tasks`.

    What a finished task was made from is not asked for: it may have been deleted.
    """
    wanted, left = set(goals), list[Task]()
    for task in reversed(tasks.values()):  # what a task needs comes before it
        if task.name in wanted and not task.finished:
            wanted.update(task.needs)
            left.append(task)
    return left[::-1]


def run_tasks(
    tasks: Sequence[Task],
    pool: Workers,
    on_progress: OnProgress,
    meanwhile: Task | None = None,
) -> None:
    """Run tasks in a pool, earlier ones first where there is a choice.

    What a task needs beyond these is done already. `on_progress` is told (label, tasks done, tasks
    in all). `meanwhile` is run by this process once what it needs is done and no task waits, while
    the pool works on the last ones; where there are no tasks it is not run.
    """
    waiting, undone = list(tasks), {task.name for task in tasks}
    total, done = Counter(task.label for task in tasks), Counter[str]()
    for label in total:
        on_progress(label, 0, total[label])

    def hand_out() -> None:
        while pool.room and (batch := _first_ready(waiting, undone)):
            for task in batch:
                waiting.remove(task)
            pool.submit(batch, _run_each, batch)

    hand_out()
    for batch, _ in pool.completed():
        for task in batch:
            undone.remove(task.name)
            done[task.label] += 1
            on_progress(task.label, done[task.label], total[task.label])
        hand_out()
        if meanwhile and not waiting and undone.isdisjoint(meanwhile.needs):
            meanwhile.run()
            meanwhile = None


def _first_ready(waiting: Sequence[Task], undone: set[str]) -> tuple[Task, ...]:
    """The first task that waits for none of those undone, and all ready ones that share with it."""
    ready = (task for task in waiting if undone.isdisjoint(task.needs))
    first = next(ready, None)
    if first is None:
        return ()
    return first, *(task for task in ready if first.shares and task.shares == first.shares)


def _run_each(tasks: Sequence[Task]) -> None:
    for task in tasks:
        task.run()
