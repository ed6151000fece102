"""Where finished stages are kept, so that nothing is computed twice."""

import json
import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.run.stage import RecordedLog, Stage
from mapfusion.storage import write_whole

_MARK = "done"


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
        text = json.dumps({"stage": self.name, "key": self.key, "figures": dict(figures)}, indent=1)
        write_whole(self.outputs[part][-1], lambda file: file.write_text(text))

    def figures(self) -> dict[str, Any]:
        """What `finish` was given, summed over the parts that are finished."""
        total = Counter[str]()
        for *_, mark in self.outputs.values():
            if mark.is_file():
                total.update(json.loads(mark.read_text())["figures"])
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

    def folder(self, stage: Stage) -> StageFolder:
        """The same with all that is known of it."""
        path = self.path(stage)
        outputs = {}
        for part in stage.parts:
            mark = f"{_MARK}_{part}.json" if part else f"{_MARK}.json"
            files = [*(name.format(part=part) for name in stage.writes), mark]
            outputs[part] = tuple(path / file for file in files)
        return StageFolder(path, stage.name, stage.key, outputs)


def explained(reason: str, store: Store) -> str:
    """What to do about a reason that names a file of the store: it is no file of the user's."""
    if str(store.root) not in reason:
        return reason
    return f"{reason}; delete its folder, then it is computed again"
