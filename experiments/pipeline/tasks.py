"""Tasks of stages: function calls with their outputs and the tasks that they depend on.

`mapfusion run` runs them in a pool of processes, `mapfusion sweep` in a Dask cluster.
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
    """Unit of work, whose results are files.

    Attributes:
        name: STAGE/KEY or STAGE/KEY/PART; tasks with the same name do the same work.
        label: name of its group in the progress display.
        function: function that is called with the arguments.
        arguments: arguments, which can be pickled.
        outputs: files that exist when the task is finished; a task without outputs is never
            finished.
        needs: names of the tasks that have to be finished before.
        shares: name of data that it keeps in memory; tasks with the same name that are ready
            together run in one process. Empty without such data.
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
        """True if all outputs exist."""
        return bool(self.outputs) and all(path.is_file() for path in self.outputs)

    def run(self) -> None:
        """Do the work, unless another process has done it meanwhile."""
        if not self.finished:
            self.function(*self.arguments)


def tasks_of(stages: Iterable[Stage], store: Store) -> dict[str, Task]:
    """Return the tasks of stages by name, each after the tasks that it needs.

    Consecutive stages with the same parts are ordered by part, so that two processes work on
    different stages and compile different kernels.
    """
    tasks = {}
    for parts, group in itertools.groupby(stages, key=lambda stage: stage.parts):
        folders = [(stage, store.folder(stage)) for stage in group]
        for part, (stage, folder) in itertools.product(parts, folders):
            needs: list[str] = []
            for before in stage.before.values():
                if isinstance(before, Stage) and before.parts == stage.parts:
                    needs.append(_name(before, part))
                else:
                    needs += task_names(before)
            inputs = {name: store.path(before) for name, before in stage.before.items()}
            name = _name(stage, part)
            tasks[name] = Task(
                name,
                stage.label,
                _perform,
                arguments=(stage.work, stage.settings, Job(inputs, folder.path, part), folder),
                outputs=folder.outputs[part],
                needs=tuple(needs),
                shares=f"{stage.shares}/{part}" if stage.shares else "",
            )
    return tasks


def task_names(stage: Stage | RecordedLog) -> list[str]:
    """Return the names of the tasks of a stage; none for a recorded log."""
    return [] if isinstance(stage, RecordedLog) else [_name(stage, part) for part in stage.parts]


def _name(stage: Stage, part: str) -> str:
    return f"{stage.name}/{stage.key}" + (f"/{part}" if part else "")


def _perform(work: Callable[..., Any], settings: Any, job: Job, folder: StageFolder) -> None:
    """Compute a part of a stage from undamaged inputs and mark it as finished."""
    for stage in job.inputs.values():
        require_undamaged(stage)
    remove_abandoned(folder.path)  # files of a process that was killed at the same task
    started = time.perf_counter()
    figures = dict(work(settings, job) or {})
    folder.finish(job.part, {"elapsed_s": time.perf_counter() - started} | figures)


def unfinished(tasks: dict[str, Task], goals: Iterable[str]) -> list[Task]:
    """Return the unfinished tasks that the named tasks need, in the order of `tasks`.

    The inputs of a finished task are not needed and may have been deleted.
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
    """Run tasks in a pool, earlier tasks first if several are ready.

    Args:
        tasks: tasks; any other tasks that they need are finished.
        pool: worker processes.
        on_progress: called with (label, finished tasks, all tasks).
        meanwhile: task that this process runs while the pool works on the last tasks, once its
            needs are finished and no task waits. It is not run without tasks.
    """
    waiting, undone = list(tasks), {task.name for task in tasks}
    total, done = Counter(task.label for task in tasks), Counter[str]()
    for label in total:
        on_progress(label, 0, total[label])

    def submit_ready() -> None:
        """Submit the first ready task, with all ready ones that share its data, until no room."""
        while pool.room:
            ready = (task for task in waiting if undone.isdisjoint(task.needs))
            first = next(ready, None)
            if first is None:
                return
            batch = (
                first,
                *(task for task in ready if first.shares and task.shares == first.shares),
            )
            for task in batch:
                waiting.remove(task)
            pool.submit(batch, _run_each, batch)

    submit_ready()
    for batch, _ in pool.completed():
        for task in batch:
            undone.remove(task.name)
            done[task.label] += 1
            on_progress(task.label, done[task.label], total[task.label])
        submit_ready()
        if meanwhile and not waiting and undone.isdisjoint(meanwhile.needs):
            meanwhile.run()
            meanwhile = None


def _run_each(tasks: Sequence[Task]) -> None:
    for task in tasks:
        task.run()
