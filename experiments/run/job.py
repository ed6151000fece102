"""What a stage is handed beside its settings: where its inputs lie, and where its output goes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


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
