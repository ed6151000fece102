"""Tasks: what is left to do, in which order, and the same whatever the pool."""

import os
import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.pipeline.tasks import Task, run_tasks, unfinished
from experiments.pipeline.workers import workers


def _append(journal: Path, name: str, output: Path) -> None:
    with journal.open("a") as file:
        file.write(f"{name}\n")
    output.write_text(name)


def tasks(folder: Path, needs: Mapping[str, Sequence[str]]) -> dict[str, Task]:
    """Tasks that note their names in a journal, one label for each first letter."""
    return {
        name: Task(
            name,
            name[0],
            _append,
            (folder / "journal", name, folder / name),
            (folder / name,),
            tuple(before),
        )
        for name, before in needs.items()
    }


def journal(folder: Path) -> list[str]:
    path = folder / "journal"
    return path.read_text().split() if path.exists() else []


_GIVE_UP_S = 60.0  # on a busy machine
_LONGER_S = 0.5
DIAMOND = {"a1": (), "a2": ("a1",), "a3": ("a1",), "b": ("a2", "a3"), "c": ("b",), "d": ()}


def test_all_that_the_goals_need_is_left_in_order(tmp_path: Path) -> None:
    made = tasks(tmp_path, DIAMOND)
    assert [task.name for task in unfinished(made, ["c"])] == ["a1", "a2", "a3", "b", "c"]
    assert [task.name for task in unfinished(made, ["d", "a3"])] == ["a1", "a3", "d"]
    assert unfinished(made, []) == []


def test_what_a_finished_task_was_made_from_is_not_wanted(tmp_path: Path) -> None:
    made = tasks(tmp_path, DIAMOND)
    (tmp_path / "b").touch()
    assert [task.name for task in unfinished(made, ["c"])] == ["c"]
    (tmp_path / "c").touch()
    assert unfinished(made, ["c"]) == []


def test_a_task_without_outputs_is_never_finished(tmp_path: Path) -> None:
    made = tasks(tmp_path, {"a": ()})["a"]
    assert not Task("x", "x", made.function, made.arguments, ()).finished


def test_a_task_is_finished_with_the_last_of_its_outputs(tmp_path: Path) -> None:
    made, outputs = tasks(tmp_path, {"a": ()})["a"], (tmp_path / "a", tmp_path / "b")
    two = Task("x", "x", made.function, made.arguments, outputs)
    for output in reversed(outputs):
        assert not two.finished
        assert unfinished({"x": two}, ["x"]) == [two]
        output.touch()
    assert two.finished


def test_a_task_done_by_somebody_else_is_not_done_again(tmp_path: Path) -> None:
    made = tasks(tmp_path, {"a": ()})["a"]
    made.run()
    made.run()
    assert journal(tmp_path) == ["a"]


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("seed", range(3))
def test_every_task_runs_once_after_those_it_needs(tmp_path: Path, jobs: int, seed: int) -> None:
    rng = random.Random(seed)
    names = [f"{rng.choice('xyz')}{i}" for i in range(20)]
    needs = {name: rng.sample(names[:i], min(i, rng.randrange(4))) for i, name in enumerate(names)}
    made = tasks(tmp_path, needs)
    told: dict[str, tuple[int, int]] = {}
    with workers(jobs) as pool:
        run_tasks(
            list(made.values()),
            pool,
            lambda label, done, total: told.update({label: (done, total)}),
        )
    ran = journal(tmp_path)
    assert sorted(ran) == sorted(names)
    for name, before in needs.items():
        assert all(ran.index(other) < ran.index(name) for other in before)
    assert all(done == total for done, total in told.values())
    assert sum(total for _, total in told.values()) == len(names)


def test_one_process_keeps_the_order_of_the_plan(tmp_path: Path) -> None:
    """Depth first: a robot is done before the next one's images are begun."""
    needs = {"w": (), "r1": ("w",), "s1": ("r1",), "r2": ("w",), "s2": ("r2",)}
    with workers(1) as pool:
        run_tasks(list(tasks(tmp_path, needs).values()), pool, lambda *_: None)
    assert journal(tmp_path) == ["w", "r1", "s1", "r2", "s2"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_tasks_that_share_are_done_by_one_process_as_far_as_they_are_ready(
    tmp_path: Path, jobs: int
) -> None:
    names = {"a1": (), "b1": (), "a2": (), "b2": (), "w": (), "a3": ("w",)}
    made = [
        replace(task, function=_append_process, shares=task.name[0] if task.name != "w" else "")
        for task in tasks(tmp_path, names).values()
    ]
    with workers(jobs) as pool:
        run_tasks(made, pool, lambda *_: None)
    ran = journal(tmp_path)
    assert sorted(name.split("@")[0] for name in ran) == sorted(names)
    by = dict(name.split("@") for name in ran)
    assert by["a1"] == by["a2"]
    assert by["b1"] == by["b2"]
    if jobs == 1:
        assert [name.split("@")[0] for name in ran] == ["a1", "a2", "b1", "b2", "w", "a3"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_this_process_does_its_part_beside_the_last_task_when_what_it_needs_is_done(
    tmp_path: Path, jobs: int
) -> None:
    """The last task waits for it, and it for the second one, which takes longer than the first."""
    made = tasks(tmp_path, {"first": (), "second": (), "last": ()})
    for name, before in {"second": "first", "last": "own"}.items():
        arguments = (*made[name].arguments, tmp_path / before)
        made[name] = replace(made[name], function=_append_after, arguments=arguments)
    own = tasks(tmp_path, {"own": ("second",)})["own"]
    with workers(jobs) as pool:
        run_tasks(list(made.values()), pool, lambda *_: None, own)
    assert journal(tmp_path) == ["first", "second", "own", "last"]


def _append_after(journal: Path, name: str, output: Path, other: Path) -> None:
    give_up = time.monotonic() + _GIVE_UP_S
    while not other.exists() and time.monotonic() < give_up:
        time.sleep(0.01)
    time.sleep(_LONGER_S)
    _append(journal, name, output)


def test_this_process_does_nothing_where_no_task_is_left(tmp_path: Path) -> None:
    """The final task is not run without tasks before it."""
    with workers(1) as pool:
        run_tasks([], pool, lambda *_: None, tasks(tmp_path, {"own": ()})["own"])
    assert journal(tmp_path) == []


def _append_process(journal: Path, name: str, output: Path) -> None:
    _append(journal, f"{name}@{os.getpid()}", output)
