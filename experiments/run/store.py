"""Finished stages, kept under a key of all they depend on, so that nothing is computed twice.

A key covers: the parts of the scenario the stage reads, the keys of the stages before it, the
source code it runs, and the versions of the libraries behind it. Changed code or settings give a
new key, so a result can be reused but never be stale.
"""

import functools
import hashlib
import importlib.metadata
import json
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapfusion.storage import write_whole

SOURCE_ROOT = Path(__file__).resolve().parents[2]
_KEY_LENGTH = 16  # hexadecimal digits: 64 bits, no collision in any store one disk can hold
_DONE = "done.json"
_TIMES = "times_"  # and the part
_NUMERICAL_LIBRARIES = (
    "numba",
    "numpy",
    "opencv-python-headless",
    "pyarrow",
    "pybullet",
    "scipy",
)


@functools.cache
def library_versions() -> dict[str, str]:
    """Installed versions of the libraries whose arithmetic ends up in the results."""
    return {name: importlib.metadata.version(name) for name in _NUMERICAL_LIBRARIES}


@functools.cache
def source_hash(parts: tuple[str, ...]) -> str:
    """Hash of the source files of packages or modules, given as paths below the project's root."""
    digest = hashlib.sha256()
    for part in parts:
        path = SOURCE_ROOT / part
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file.suffix in {".py", ".urdf"}:
                digest.update(str(file.relative_to(SOURCE_ROOT)).encode() + b"\0")
                digest.update(file.read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class StageFolder:
    """Where one stage keeps what it made."""

    stage: str
    key: str
    path: Path

    @property
    def mark(self) -> Path:
        """The file that says that the stage ran to its end."""
        return self.path / _DONE

    @property
    def finished(self) -> bool:
        """Whether the stage ran to its end."""
        return self.mark.is_file()

    def finish(self, **figures: Any) -> None:
        """Mark the stage as finished, with figures about the run (times; never results)."""
        text = json.dumps({"stage": self.stage, "key": self.key, **figures}, indent=1)
        write_whole(self.mark, lambda file: file.write_text(text))

    def figures(self) -> dict[str, Any]:
        """What `finish` was given."""
        return json.loads(self.mark.read_text())

    def note(self, part: str, **seconds: float) -> None:
        """Keep the times of one part of the stage."""
        text = json.dumps(seconds)
        write_whole(self.path / f"{_TIMES}{part}.json", lambda file: file.write_text(text))

    def noted(self) -> dict[str, float]:
        """The times of all parts, added up."""
        total = Counter[str]()
        for path in sorted(self.path.glob(f"{_TIMES}*.json")):
            total.update(json.loads(path.read_text()))
        return dict(total)

    def discard(self) -> None:
        """Forget the stage's results."""
        shutil.rmtree(self.path, ignore_errors=True)


@dataclass(frozen=True)
class Store:
    """All stage folders below one root."""

    root: Path

    def stage(
        self, stage: str, settings: Any, upstream: Sequence[StageFolder], sources: tuple[str, ...]
    ) -> StageFolder:
        """The folder of a stage with these settings (JSON-able) after these stages."""
        content = {
            "stage": stage,
            "settings": settings,
            "upstream": [folder.key for folder in upstream],
            "source": source_hash(sources),
            "libraries": library_versions(),
        }
        text = json.dumps(content, sort_keys=True, default=str)
        key = hashlib.sha256(text.encode()).hexdigest()[:_KEY_LENGTH]
        return StageFolder(stage, key, self.root / stage / key)

    def imported(self, stage: str, path: Path) -> StageFolder:
        """A folder that came from elsewhere; its key is the hash of what it holds."""
        digest = hashlib.sha256()
        for file in sorted(path.glob("*.parquet")):
            digest.update(file.name.encode() + b"\0")
            digest.update(file.read_bytes())
        return StageFolder(stage, digest.hexdigest()[:_KEY_LENGTH], path)


def explained(reason: str, store: Store) -> str:
    """What to do about a reason that names a file of the store: it is no file of the user's."""
    if str(store.root) not in reason:
        return reason
    return f"{reason}; delete its folder, then it is computed again"


def link_or_copy(source: Path, target: Path) -> None:
    """Put a finished, immutable file at a second place without a second copy where possible."""

    def place(temporary: Path) -> None:
        temporary.unlink()
        try:
            temporary.hardlink_to(source)
        except OSError:
            shutil.copyfile(source, temporary)

    write_whole(target, place)
