"""Tasks that misbehave, importable in worker processes."""

import os
import signal
from pathlib import Path

from experiments.pipeline.store import StageFolder, require_undamaged
from mapfusion.errors import InputError
from mapfusion.files import require_file
from tests.helpers.waiting import wait_until


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def note(journal: Path, text: str) -> None:
    with journal.open("a") as file:
        file.write(f"{text}\n")


def _raise_flag(flag: Path | None) -> None:
    """Others may wait for it."""
    if flag is not None:
        flag.touch()


def collide(flag: Path | None = None) -> None:
    _raise_flag(flag)
    raise InputError("scenario x: R1 drove into\n a wall at (1, 2)")


def run_out_of_memory() -> None:
    raise MemoryError


def break_down(flag: Path | None = None) -> None:
    _raise_flag(flag)
    raise ZeroDivisionError("a bug")


def die(journal: Path) -> None:
    note(journal, "died")
    os.kill(os.getpid(), signal.SIGKILL)


def die_first(journal: Path, path: Path) -> None:
    """Killed twice, then all is well."""
    if not journal.exists() or len(journal.read_text().split()) < 2:
        die(journal)
    write(path, "done")


def wait_for(path: Path, output: Path) -> None:
    assert wait_until(path.exists)
    write(output, "done")


def write_stage(path: Path, text: str = "made") -> None:
    """Write a file and mark its folder as that of a finished stage, in which it holds `made`."""
    write(path, "made")
    StageFolder(path.parent, "drive", "k", {"": (path.parent / "done.json",)}).finish("", {})
    if text != "made":
        write(path, text)


def read_stage(path: Path, output: Path) -> None:
    require_undamaged(path.parent)
    require_file(path, "test")  # the stage may have been discarded meanwhile
    write(output, path.read_text())
