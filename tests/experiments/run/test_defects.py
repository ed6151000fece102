"""What no input may cause is told in one line, with the place and the whole traceback in a file."""

import inspect
from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.cli import main as cli
from experiments.pipeline.workers import saved_defect, workers
from tests.helpers import acting
from tests.helpers.tiny_scenario import command


def raised(work: Callable[[], object]) -> BaseException:
    try:
        work()
    except ZeroDivisionError as error:
        return error
    raise AssertionError("it did not raise")


def in_a_worker() -> None:
    with workers(2) as pool:
        pool.submit("task", acting.break_down)
        list(pool.completed())


@pytest.mark.parametrize("work", [acting.break_down, in_a_worker])
def test_the_place_is_where_it_was_raised(work: Callable[[], object]) -> None:
    told = saved_defect(raised(work))
    assert "\n" not in told
    assert "ZeroDivisionError a bug at " in told
    lines, first = inspect.getsourcelines(acting.break_down)
    assert f"acting.py:{first + len(lines) - 1} in break_down;" in told  # its last
    details = Path(told.rpartition(": ")[2])
    assert 'raise ZeroDivisionError("a bug")' in details.read_text(encoding="utf-8")
    details.unlink()


def test_it_has_an_exit_code_of_its_own(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "app", lambda **_: acting.break_down())
    reply = command(capsys, "run", "x.yaml")
    assert reply.code == 70
    assert reply.err.startswith("mapfusion: a defect of mapfusion itself: ZeroDivisionError a bug")
    assert len(reply.err.splitlines()) == 1
    Path(reply.err.strip().rpartition(": ")[2]).unlink()
