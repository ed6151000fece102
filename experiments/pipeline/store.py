"""Store of finished stages, so that nothing is computed twice."""

import shutil
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from experiments.pipeline.stage import RecordedLog, Stage
from mapfusion.errors import DamagedFileError, MendedWarning
from mapfusion.files import is_intact, read_json, read_sealed, write_json, write_whole


def link_or_copy(source: Path, target: Path) -> None:
    """Put a finished, immutable file at a second place without a second copy where possible.

    Raises:
        DamagedFileError: there is none, or it is not as it was written.
    """
    read_sealed(source, "finished file")

    def place(temporary: Path) -> None:
        temporary.unlink()
        try:
            temporary.hardlink_to(source)
        except OSError:
            shutil.copyfile(source, temporary)

    write_whole(target, place)


_MARK = "done"
_FIGURES = TypeAdapter(dict[str, float])
_DEPTH = 3  # a stage's file is STAGE/KEY/FILE
# A disk that damages every file is none that the store can mend.
_MENDED_AT_MOST = 2
_TOLD_LATE_AT_MOST = 1000  # more tasks than a sweep has at work at one time
T = TypeVar("T")


@dataclass(frozen=True)
class StageFolder:
    """Where one stage keeps what it made."""

    path: Path
    name: str
    key: str
    outputs: Mapping[str, tuple[Path, ...]]  # by part; the last of each is the mark of its end

    @property
    def finished(self) -> bool:
        """Whether all it writes is there."""
        return all(file.is_file() for files in self.outputs.values() for file in files)

    def finish(self, part: str, figures: Mapping[str, float]) -> None:
        """Mark a part as finished, with figures about the work (times; never results)."""
        told = {"stage": self.name, "key": self.key, "figures": dict(figures)}
        write_json(self.outputs[part][-1], told)

    def figures(self) -> dict[str, Any]:
        """What `finish` was given, summed over the parts that are finished.

        Raises:
            DamagedFileError: a mark is no such file.
        """
        total = Counter[str]()
        for *_, mark in self.outputs.values():
            if mark.is_file():
                total.update(_figures(mark))
        return dict(total)

    def discard(self) -> None:
        """Forget the stage's results."""
        shutil.rmtree(self.path, ignore_errors=True)


@dataclass(frozen=True)
class Store:
    """All stage folders below one root."""

    root: Path

    @classmethod
    def of(cls, results: Path) -> "Store":
        """The store in a folder of results."""
        return cls(results / "store")

    def path(self, stage: Stage | RecordedLog) -> Path:
        """Where what a stage made is or will be."""
        return stage.path if isinstance(stage, RecordedLog) else self.root / stage.name / stage.key

    def discard_damaged(self, error: DamagedFileError, mended: Counter[Path]) -> bool:
        """Forget the stage that a damaged file belongs to, and warn.

        Others may have read the file before that and tell later: then there is nothing to do.

        Args:
            error: what was read.
            mended: counts, over the calls of one command.

        Returns:
            False for a file that no stage made, or one that was damaged too often.
        """
        path, root = error.path.resolve(), self.root.resolve()
        parts = path.relative_to(root).parts if path.is_relative_to(root) else ()
        if len(parts) < _DEPTH:
            return False
        stage = root.joinpath(*parts[:2])
        if mended[path] and (not path.is_file() or is_intact(path.read_bytes())):
            mended[stage] += 1
            return mended[stage] <= _TOLD_LATE_AT_MOST
        mended[path] += 1
        if mended[path] > _MENDED_AT_MOST:
            return False
        shutil.rmtree(stage, ignore_errors=True)
        again = f"the stage {stage.parent.name} is discarded and computed again"
        warnings.warn(f"{error}; {again}", MendedWarning, stacklevel=2)
        return True

    def folder(self, stage: Stage) -> StageFolder:
        """The same with all that is known of it."""
        path = self.path(stage)
        outputs = {}
        for part in stage.parts:
            mark = f"{_MARK}_{part}.json" if part else f"{_MARK}.json"
            files = [*(name.format(part=part) for name in stage.writes), mark]
            outputs[part] = tuple(path / file for file in files)
        return StageFolder(path, stage.name, stage.key, outputs)


def _figures(mark: Path) -> dict[str, float]:
    try:
        return _FIGURES.validate_python(read_json(mark, "mark of a finished stage").get("figures"))
    except ValidationError as error:
        raise DamagedFileError(mark, "holds no figures about a finished stage") from error


def mending(store: Store, work: Callable[[], T]) -> T:
    """What `work` gives, called again after each damaged stage of the store that it comes across.

    `work` makes again what is no longer there. What it finds is told as a warning.

    Raises:
        DamagedFileError: a file outside the store, or one that is damaged again and again.
    """
    mended = Counter[Path]()
    while True:
        try:
            return work()
        except DamagedFileError as error:
            if not store.discard_damaged(error, mended):
                raise
