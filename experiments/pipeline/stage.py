"""Stage of a run: a declared value, from which its key and its sources follow.

A key covers: the stage's settings, the keys of the stages before it, the source that its function
runs (from the imports), and the versions of the libraries behind it. Changed code or settings give
a new key, so a result can be reused but never be stale. The function is handed its settings and
its job, nothing else: what is not in the key it cannot read.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python

from experiments.pipeline.code_version import imported_sources, library_versions, source_hash


@dataclass(frozen=True)
class Job:
    """One piece of a stage's work.

    Attributes:
        inputs: folders of the stages before it, by the names that the stage gives them.
        output: the stage's own folder.
        part: which of its parts to make; empty for a stage made in one piece.
    """

    inputs: Mapping[str, Path]
    output: Path
    part: str = ""


_KEY_LENGTH = 16  # hexadecimal digits: 64 bits, no collision in any store one disk can hold
WHOLE = ("",)  # the parts of a stage that is made in one piece

# Returns further figures about the work (times; never results), if there are any.
Work = Callable[[Any, Job], Mapping[str, float] | None]


@dataclass(frozen=True, eq=False)
class Stage:
    """One declared step from inputs to files.

    Attributes:
        name: of the kind of stage, and of its folder in the store.
        label: what the screen calls it.
        settings: a frozen value, all of which is in the key.
        work: a function of a module, `work(settings, job)`; the module's imports are its source.
        writes: names of files that are there once a part is made, `{part}` in place of its name.
        before: stages whose folders it reads, by the names it knows them by.
        parts: made apart from each other, in any order; each needs all of the stages before it,
            but of one with the same parts its own counterpart alone.
        loads: modules that it finds by name, which no import shows.
        shares: a name for what it reads or makes ready in memory; stages of one name have it in
            common, part by part. It has no say in what they make.
    """

    name: str
    label: str
    settings: Any
    work: Work
    writes: tuple[str, ...] = ()
    before: Mapping[str, "Stage | RecordedLog"] = field(default_factory=dict)
    parts: tuple[str, ...] = WHOLE
    loads: tuple[str, ...] = ()
    shares: str = ""

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """Files of ours whose content is in the key."""
        return imported_sources(self.work.__module__, *self.loads)

    @cached_property
    def key(self) -> str:
        """Names the results among all of the same stage."""
        content = {
            "stage": self.name,
            "settings": to_jsonable_python(self.settings),
            "before": {name: stage.key for name, stage in self.before.items()},
            "source": source_hash(self.sources),
            "libraries": library_versions(),
        }
        text = json.dumps(content, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:_KEY_LENGTH]


@dataclass(frozen=True)
class RecordedLog:
    """A robot log that was there before: a stage that is finished; its key is what it holds."""

    path: Path

    @cached_property
    def key(self) -> str:
        """Hash of its tables."""
        digest = hashlib.sha256()
        tables = [*self.path.glob("[!.]*.parquet"), *self.path.glob("[!.]*.csv")]
        for file in sorted(tables):
            digest.update(file.name.encode() + b"\0")
            digest.update(file.read_bytes())
        return digest.hexdigest()[:_KEY_LENGTH]


def in_dependency_order(goals: "Iterable[Stage | RecordedLog]") -> list[Stage]:
    """Stages and all that come before them, each once and after those before it."""
    found: dict[Stage, None] = {}
    for goal in goals:
        if isinstance(goal, Stage):
            found |= dict.fromkeys([*in_dependency_order(goal.before.values()), goal])
    return list(found)
