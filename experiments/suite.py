"""Scenarios by file or tag."""

from collections.abc import Sequence
from pathlib import Path

from mapfusion.errors import InputError


def scenarios_of(names_or_tags: Sequence[str], folder: Path) -> list[Path]:
    """Scenario files that are named; raises InputError."""
    paths = [Path(name) for name in names_or_tags]
    for path in paths:
        if not path.is_file():
            raise InputError(f"{path}: no such file (expected a scenario, for example quick.yaml)")
    return list(dict.fromkeys(paths))
