"""Faults that tests must notice, as data: `*.yaml` beside this file.

Each file maps a source file to faults by name; each has the text that is there (`old`, once), what
a careless change would make of it (`new`), and the narrowest tests that must fail then.
"""

from pathlib import Path
from typing import NamedTuple

from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[2]


class Fault(NamedTuple):
    """One careless change of one file, and the test files that must notice."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, text: str) -> str:
        """The source with the fault in it; raises ValueError unless `old` is there once."""
        if (count := text.count(self.old)) != 1:
            raise ValueError(f"{self.name}: {self.file} holds its old text {count} times, not once")
        return text.replace(self.old, self.new)


def all_faults() -> list[Fault]:
    """Every fault there is."""
    return [
        Fault(name, file, fault["old"], fault["new"], tuple(fault["tests"].split()))
        for listed in sorted(Path(__file__).parent.glob("*.yaml"))
        for file, faults in YAML(typ="safe").load(listed).items()
        for name, fault in faults.items()
    ]
