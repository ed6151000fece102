"""Store of finished stages, so that nothing is computed twice.

A stage has a folder. When a part of the stage is finished, a file `done.json`, or `done_PART.json`,
lists the files of the part with their sizes and digests. Readers of the stage check them first.
"""

import shutil
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from experiments.pipeline.stage import RecordedLog, Stage
from mapfusion.errors import DamagedFileError, StoreRepairWarning
from mapfusion.files import PART, digest_of, read_json, require_file, write_atomically, write_json

# Number of digests that a process keeps in memory: those of some thousand stages.
_DIGESTS_KEPT = 100_000
# A file that is newer than this may change without a new modification time: clocks of file systems
# have a resolution of up to 2 s (FAT).
_NEW_NS = 2_000_000_000


class FileEntry(BaseModel):
    """Size in bytes and SHA-256 (hexadecimal digits) of a file when it was written."""

    size: int
    sha256: str


def file_entries(folder: Path, files: Iterable[Path]) -> dict[str, dict[str, object]]:
    """Return the entry of each file, as JSON can hold it, by its path within the folder."""
    entries = {}
    for path in sorted(files):
        entry = {"size": path.stat().st_size, "sha256": digest_of(path)}
        entries[path.relative_to(folder).as_posix()] = entry
    return entries


def require_unchanged(folder: Path, entries: Mapping[str, FileEntry], pattern: str = "*") -> None:
    """Check the files of a folder against their entries.

    Args:
        folder: folder of the files.
        entries: entries by path within the folder.
        pattern: pattern of the paths to check.

    Raises:
        DamagedFileError: a file is missing, or differs from its entry.
    """
    for name, entry in entries.items():
        if not fnmatch(name, pattern):
            continue
        path = folder / name
        require_file(path, "file that was written")
        found = path.stat()
        is_new = time.time_ns() - found.st_mtime_ns < _NEW_NS
        digest = digest_of(path) if is_new else _known_digest(path, found.st_mtime_ns)
        if (found.st_size, digest) != (entry.size, entry.sha256):
            raise DamagedFileError(path, "damaged, it is not as it was written")


@lru_cache(maxsize=_DIGESTS_KEPT)
def _known_digest(path: Path, changed_ns: int) -> str:
    """Return the digest of a file that was last changed at a time."""
    return digest_of(path)


def link_or_copy(source: Path, target: Path) -> None:
    """Place a finished file at a second path, by a hard link if the file system allows it.

    Raises:
        DamagedFileError: there is no such file.
    """
    require_file(source, "finished file")

    def place(temporary: Path) -> None:
        temporary.unlink()
        try:
            temporary.hardlink_to(source)
        except OSError:
            shutil.copyfile(source, temporary)

    write_atomically(target, place)


_MARK = "done"
_DEPTH = 3  # the file of a stage is STAGE/KEY/FILE
# Number of times that a file is computed again in one command; more damage needs a person.
_MENDED_AT_MOST = 2
_TOLD_LATE_AT_MOST = 1000  # bound on late reports of one damage; more than the tasks at work
T = TypeVar("T")


class _Mark(BaseModel):
    """Content of the mark of a finished part."""

    figures: dict[str, float]
    files: dict[str, FileEntry]


@dataclass(frozen=True)
class StageFolder:
    """Folder of one stage."""

    path: Path
    name: str
    key: str
    outputs: Mapping[str, tuple[Path, ...]]  # by part; the last file of each is its mark

    @property
    def finished(self) -> bool:
        """True if all files exist."""
        return all(file.is_file() for files in self.outputs.values() for file in files)

    def finish(self, part: str, figures: Mapping[str, float]) -> None:
        """Mark a part as finished, with figures about the work (times; never results).

        The mark lists all files in the folder, except the outputs of other parts.
        """
        mark = self.outputs[part][-1]
        others = {file for each, files in self.outputs.items() if each != part for file in files}
        made = set(self.path.iterdir()) - others - {mark}
        entries = file_entries(self.path, (file for file in made if file.suffix != PART))
        known = {"stage": self.name, "key": self.key}
        write_json(mark, {**known, "figures": dict(figures), "files": entries})

    def quantities(self) -> dict[str, Any]:
        """Return the quantities stored by `finish`, such as times, summed over the finished parts.

        Raises:
            DamagedFileError: a mark is damaged.
        """
        total = Counter[str]()
        for *_, mark in self.outputs.values():
            if mark.is_file():
                total.update(_read_mark(mark).figures)
        return dict(total)

    def discard(self) -> None:
        """Remove the results of the stage."""
        shutil.rmtree(self.path, ignore_errors=True)


def require_undamaged(stage: Path, pattern: str = "*") -> None:
    """Check the files in the folder of a stage against the marks of its finished parts.

    A folder without marks, such as a recorded log, is not checked.

    Args:
        stage: folder of the stage.
        pattern: pattern of the names of the files to check.

    Raises:
        DamagedFileError: a file or a mark is missing or damaged.
    """
    for mark in sorted(stage.glob(f"{_MARK}*.json")):
        require_unchanged(stage, _read_mark(mark).files, pattern)


@dataclass(frozen=True)
class Store:
    """Folders of all stages, below one root."""

    root: Path

    @classmethod
    def of(cls, results: Path) -> "Store":
        """Return the store in a folder of results."""
        return cls(results / "store")

    def path(self, stage: Stage | RecordedLog) -> Path:
        """Return the folder of a stage."""
        return stage.path if isinstance(stage, RecordedLog) else self.root / stage.name / stage.key

    def discard_damaged(self, error: DamagedFileError, mended: Counter[Path]) -> bool:
        """Remove the stage that a damaged file belongs to, and warn.

        Nothing is done if another task has reported the same damage before and the stage has been
        computed again since.

        Args:
            error: error that names the damaged file.
            mended: number of times that each file has been computed again in this command; changed.

        Returns:
            False if the file belongs to no stage, or if it has been damaged too often.
        """
        path, root = error.path.resolve(), self.root.resolve()
        parts = path.relative_to(root).parts if path.is_relative_to(root) else ()
        if len(parts) < _DEPTH:
            return False
        stage = root.joinpath(*parts[:2])
        if mended[path] and (not path.is_file() or _is_undamaged(stage)):
            mended[stage] += 1
            return mended[stage] <= _TOLD_LATE_AT_MOST
        mended[path] += 1
        if mended[path] > _MENDED_AT_MOST:
            return False
        shutil.rmtree(stage, ignore_errors=True)
        again = f"the stage {stage.parent.name} is discarded and computed again"
        warnings.warn(f"{error}; {again}", StoreRepairWarning, stacklevel=2)
        return True

    def folder(self, stage: Stage) -> StageFolder:
        """Return the folder of a stage with the names of its outputs."""
        path = self.path(stage)
        outputs = {}
        for part in stage.parts:
            mark = f"{_MARK}_{part}.json" if part else f"{_MARK}.json"
            files = [*(name.format(part=part) for name in stage.writes), mark]
            outputs[part] = tuple(path / file for file in files)
        return StageFolder(path, stage.name, stage.key, outputs)


def _read_mark(path: Path) -> _Mark:
    """Read a mark; raises DamagedFileError."""
    try:
        return _Mark.model_validate(read_json(path, "mark of a finished stage"))
    except ValidationError as error:
        raise DamagedFileError(path, "is not the mark of a finished stage") from error


def _is_undamaged(stage: Path) -> bool:
    """Return True if no file of a stage is damaged."""
    try:
        require_undamaged(stage)
    except DamagedFileError:
        return False
    return True


def retry_damaged(store: Store, work: Callable[[], T]) -> T:
    """Return the result of `work`; call it again if it has read a damaged stage of the store.

    The stage is removed with a warning, and `work` has to compute it again.

    Raises:
        DamagedFileError: a damaged file is outside the store or has been damaged too often.
    """
    mended = Counter[Path]()
    while True:
        try:
            return work()
        except DamagedFileError as error:
            if not store.discard_damaged(error, mended):
                raise
