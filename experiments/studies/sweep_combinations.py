"""Runs of a sweep: scenarios x seeds x the values of each `--set`."""

import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.evaluation.metrics import load_checked
from experiments.scenario.settings import AnyScenario
from experiments.scenario.yaml_files import parse_value, read_mapping
from mapfusion.errors import InputError

_HASH_LENGTH = 8  # hexadecimal digits of a run's values: 32 bits, and clashes are refused
_EXPECTED = "expected key=value,value, for example slam.filter.n_particles=50,200"
_FIXED = {"seed": "--seeds 0..4", "name": "one sweep for each name"}

# Values of each dotted key, as YAML in one spelling (0.10 is 0.1).
Axes = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class SweepRun:
    """One run of a sweep.

    Attributes:
        path: file of the scenario.
        scenario: its name.
        seed: of the run.
        settings: key and value of each `--set`.
        content: content of the file when the sweep began, one object for all runs of a scenario.
            So a later change of the file does not change the runs.
    """

    path: Path
    scenario: str
    seed: int
    settings: tuple[tuple[str, str], ...] = ()
    content: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def run_id(self) -> str:
        """Name of the run; the same scenario, seed and values give the same name."""
        if not self.settings:
            return f"{self.scenario}-{self.seed}"
        digest = hashlib.sha256(json.dumps(sorted(self.settings)).encode()).hexdigest()
        return f"{self.scenario}-{self.seed}-{digest[:_HASH_LENGTH]}"

    def load(self) -> AnyScenario:
        """Return the scenario of this run; raises InputError."""
        overrides = [f"{key}={value}" for key, value in self.settings]
        return load_checked(self.path, overrides, self.seed, self.content)


def parse_axes(entries: Sequence[str]) -> Axes:
    """Parse `--set KEY=VALUE,VALUE,...`; raises InputError that shows the correct form."""
    axes: dict[str, tuple[str, ...]] = {}
    for entry in entries:
        key, _, listed = entry.partition("=")
        if not key or not listed.strip():
            raise InputError(f"--set {entry}: {_EXPECTED}")
        if key in _FIXED:
            raise InputError(f"--set {entry}: {key} cannot be set here; use {_FIXED[key]}")
        if key in axes:
            raise InputError(f"--set {key}: given twice; write its values as {key}=A,B")
        values = parse_value(f"[{listed}]", f"--set {entry}: {_EXPECTED}")
        # Text stays as it is unless YAML would read another type; everything else becomes JSON.
        axes[key] = tuple(
            value
            if isinstance(value, str) and parse_value(value, "--set") == value
            else json.dumps(value, default=str)
            for value in values
        )
        for value in axes[key]:
            if axes[key].count(value) > 1:
                raise InputError(f"--set {entry}: {value} is given twice")
    return axes


def runs_of(paths: Sequence[Path], seeds: Sequence[int], axes: Axes) -> list[SweepRun]:
    """Return all combinations; runs that share many stages follow each other.

    Each scenario file is read once. It is loaded with every combination of values, so a wrong value
    is reported before anything is computed.

    Raises:
        InputError: a scenario, key or value is wrong, or two scenarios have the same name.
    """
    choices = ([(key, value) for value in values] for key, values in axes.items())
    combinations = list(itertools.product(*choices))
    runs: list[SweepRun] = []
    names: dict[str, Path] = {}
    for path in paths:
        content = read_mapping(path)
        first = (SweepRun(path, "", seeds[0], each, content) for each in combinations)
        (name,) = {run.load().name for run in first}
        if names.setdefault(name, path) != path:
            raise InputError(f"{path}: is named {name}, as {names[name]} is; names must differ")
        runs += [
            SweepRun(path, name, *each, content) for each in itertools.product(seeds, combinations)
        ]
    if len({run.run_id for run in runs}) < len(runs):
        raise InputError("--set: two combinations of values have the same hash; split the sweep")
    return runs
