"""Stage of a run: settings, work and inputs, with a key that identifies the results.

A key is a hash of the stage's settings, the keys of the stages before it, the sources that its
function imports, and the versions of the libraries. Changed code or settings give a new key, so
stored results are never outdated. The function only receives its settings and its job, so it cannot
read anything that is not in the key.
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
    """Part of a stage's work.

    Attributes:
        inputs: folders of the stages before it, by the names that the stage gives them.
        output: folder of the stage.
        part: name of the part; empty for a stage with one part.
    """

    inputs: Mapping[str, Path]
    output: Path
    part: str = ""


_KEY_LENGTH = 16  # hexadecimal digits: 64 bits, no collision in any store one disk can hold
WHOLE = ("",)  # parts of a stage that is computed as a whole

# Function of a stage; returns further figures about the work (times; never results) or None.
Work = Callable[[Any, Job], Mapping[str, float] | None]


@dataclass(frozen=True, eq=False)
class Stage:
    """Step from inputs to files.

    Attributes:
        name: name of the kind of stage, and of its folder in the store.
        label: name in the progress display.
        settings: frozen settings, which are part of the key.
        work: function `work(settings, job)` of a module, whose imports are the sources.
        writes: names of the files of a finished part, with `{part}` in place of its name.
        before: stages whose folders it reads, by the names that it gives them.
        parts: names of the parts, which are independent of each other. A part needs all parts of
            the stages before it, but only the same part of a stage with the same parts.
        loads: modules that it imports by name.
        shares: name of data that it keeps in memory; stages with the same name share the data of
            a part. It does not affect the results.
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
        """Source files whose content is part of the key."""
        return imported_sources(self.work.__module__, *self.loads)

    @cached_property
    def key(self) -> str:
        """Key that identifies the results among those of the same stage."""
        # results without the simulator stay valid when it is installed later
        simulator = any(path.startswith("sim/") for path in self.sources)
        content = {
            "stage": self.name,
            "settings": to_jsonable_python(self.settings),
            "before": {name: stage.key for name, stage in self.before.items()},
            "source": source_hash(self.sources),
            "libraries": library_versions(simulator=simulator),
        }
        text = json.dumps(content, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:_KEY_LENGTH]


@dataclass(frozen=True)
class RecordedLog:
    """Recorded robot log: a finished stage, whose key is a hash of its content."""

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
    """Return stages and all stages before them, each once and after the stages that it needs."""
    found: dict[Stage, None] = {}
    for goal in goals:
        if isinstance(goal, Stage):
            found |= dict.fromkeys([*in_dependency_order(goal.before.values()), goal])
    return list(found)
