"""What a Dask worker does with one task; also what it does when it starts."""

import functools
import pickle
import platform
import threading
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path

from experiments.run.code_version import library_versions, source_hash
from experiments.run.defects import described
from experiments.run.kernel_cache import use_kernel_cache
from mapfusion.errors import DamagedFileError, InputError, UnsealedWarning

# Tasks keep state of their process (the open PyBullet world, OpenCV's threads), so a worker that
# was started with several threads works with one at a time.
_one_at_a_time = threading.Lock()


class TaskFailedError(Exception):
    """A task raised: its name and the reason in one line.

    And the traceback where it is a defect, or the error where it read a damaged file.
    """

    def __init__(
        self, task: str, reason: str, details: str = "", damage: DamagedFileError | None = None
    ) -> None:
        super().__init__(task, reason, details, damage)
        self.task, self.reason, self.details, self.damage = task, reason, details, damage


class UnfitWorkerError(Exception):
    """A worker that cannot take part, with the reason: nothing it did would be of use."""


@dataclass(frozen=True)
class Terms:
    """What all tasks of a sweep have in common.

    Attributes:
        attempts: folder with a file for each task at work; one byte for each time it was begun.
        retries: how often a task is begun again after the worker at it was killed.
        code: `code_version()` of the machine that plans.
    """

    attempts: Path
    retries: int
    code: str


@functools.cache
def code_version() -> str:
    """Source and libraries: where they differ, results would be kept under wrong keys."""
    return f"{source_hash()} {sorted(library_versions().items())} {platform.machine()}"


@functools.cache
def _prepare() -> None:
    """Once a process, before anything is imported that computes."""
    use_kernel_cache()
    warnings.simplefilter("ignore", UnsealedWarning)  # the command says it
    from experiments.methods.threads import single_threaded

    single_threaded()


def perform(name: str, task: bytes, terms: Terms, *needs: None) -> None:
    """Run a task, pickled so that it is unpacked only after this process is prepared.

    `needs` are results of the tasks before it (all None), so that Dask knows the order.

    Raises:
        TaskFailedError: the task raised, or its workers were killed too often.
        UnfitWorkerError: this machine does not see the folder or has another version installed.
    """
    if not terms.attempts.is_dir():
        raise UnfitWorkerError(
            f"worker on {platform.node()} does not see {terms.attempts.parent}: the folder of "
            "results must be shared by all machines, under the same path"
        )
    if code_version() != terms.code:
        raise UnfitWorkerError(
            f"worker on {platform.node()} has other source or libraries than this machine: "
            "install the same version everywhere and start the workers again"
        )
    with _one_at_a_time:
        _prepare()
        _attempt(name, task, terms)


def _attempt(name: str, task: bytes, terms: Terms) -> None:
    """Run it under a mark: only a killed process leaves the mark behind."""
    stage = name.partition("/")[0]
    mark = terms.attempts / name.replace("/", "_")
    if mark.exists() and mark.stat().st_size > terms.retries:
        killed = f"its worker was killed {terms.retries + 1} times (out of memory?)"
        raise TaskFailedError(name, f"{stage}: {killed}")
    with mark.open("ab") as file:
        file.write(b".")
    try:
        pickle.loads(task).run()  # noqa: S301 (our own client's)
    except InputError as error:
        damage = error if isinstance(error, DamagedFileError) else None
        raise TaskFailedError(name, " ".join(str(error).split()), damage=damage) from None
    except (OSError, MemoryError) as error:  # of this machine: full, or not ours to write to
        reason = " ".join(f"{stage}: {type(error).__name__} {error}".split())
        raise TaskFailedError(name, reason) from None
    except Exception as error:
        details = traceback.format_exc()
        raise TaskFailedError(name, f"{stage}: {described(error, details)}", details) from None
    finally:
        mark.unlink(missing_ok=True)
