"""Which runs a sweep is made of: scenarios x seeds x the values of each `--set`."""

import hashlib
import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.judge.expectations import load_checked
from experiments.scenario.settings import AnyScenario
from experiments.scenario.yaml_input import parse_value
from mapfusion.errors import InputError

_HASH_LENGTH = 8  # hexadecimal digits of a run's values: 32 bits, and clashes are refused
_OPENING, _CLOSING, _QUOTES = "[{(", "]})", "\"'"
_FIXED = {"seed": "--seeds 0..4", "name": "one sweep for each name"}


@dataclass(frozen=True)
class Axis:
    """One setting and the values it takes.

    Attributes:
        key: dotted, as in `--set`.
        values: as they were given (YAML).
        texts: the same in one spelling each (0.10 is 0.1), for columns and names.
    """

    key: str
    values: tuple[str, ...]
    texts: tuple[str, ...]


@dataclass(frozen=True)
class Run:
    """One run of a sweep.

    Attributes:
        path: scenario file.
        scenario: its name.
        seed: replaces the scenario's.
        overrides: entries `key=value`.
        settings: text of each axis' value, in the order of the axes.
    """

    path: Path
    scenario: str
    seed: int
    overrides: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()

    @property
    def run_id(self) -> str:
        """Names the run's files: the same scenario, seed and values give the same name."""
        if not self.overrides:
            return f"{self.scenario}-{self.seed}"
        keys = [override.partition("=")[0] for override in self.overrides]
        values = json.dumps(sorted(zip(keys, self.settings, strict=True)))
        digest = hashlib.sha256(values.encode()).hexdigest()[:_HASH_LENGTH]
        return f"{self.scenario}-{self.seed}-{digest}"

    def load(self) -> AnyScenario:
        """The scenario of this run; raises InputError."""
        return load_checked(self.path, self.overrides, self.seed)


def parse_axes(entries: Sequence[str]) -> list[Axis]:
    """`--set KEY=VALUE,VALUE,...` entries; raises InputError that shows how it is written."""
    axes = [_parse_axis(entry) for entry in entries]
    keys = [axis.key for axis in axes]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f"--set {key}: given twice; write its values as {key}=A,B")
    return axes


def _parse_axis(entry: str) -> Axis:
    key, separator, listed = entry.partition("=")
    values = _split(listed)
    if not separator or not key or not all(values):
        raise InputError(
            f"--set {entry}: expected key=value,value, for example slam.filter.n_particles=50,200"
        )
    if key in _FIXED:
        raise InputError(f"--set {entry}: {key} cannot be set here; use {_FIXED[key]}")
    texts = tuple(_one_spelling(parse_value(value, f"--set {entry}")) for value in values)
    for text in texts:
        if texts.count(text) > 1:
            raise InputError(f"--set {entry}: {text} is given twice")
    return Axis(key, values, texts)


def _split(listed: str) -> tuple[str, ...]:
    """Values between commas; those inside brackets or quotes part nothing."""
    values, depth, quote = [""], 0, ""
    for character in listed:
        if quote:
            quote = "" if character == quote else quote
        elif character in _QUOTES:
            quote = character
        else:
            depth += (character in _OPENING) - (character in _CLOSING)
        if character == "," and not depth and not quote:
            values.append("")
        else:
            values[-1] += character
    return tuple(value.strip() for value in values)


def _one_spelling(value: Any) -> str:
    """Text is itself, unless YAML would read something else in it; all else is JSON."""
    if isinstance(value, str) and parse_value(value, "--set") == value:
        return value
    return json.dumps(value, default=str)


def runs_of(paths: Sequence[Path], seeds: Sequence[int], axes: Sequence[Axis]) -> list[Run]:
    """All combinations; runs that share most come one after the other.

    Every scenario is loaded once with every combination of values, so that a wrong one is told
    before anything is computed.

    Raises:
        InputError: a scenario, key or value is wrong, or two scenarios have the same name.
    """
    runs: list[Run] = []
    names: dict[str, Path] = {}
    combinations = list(_combinations(axes))
    for path in paths:
        loaded = [load_checked(path, overrides, seeds[0]) for overrides, _ in combinations]
        name = loaded[0].name
        if names.setdefault(name, path) != path:
            raise InputError(f"{path}: is named {name}, as {names[name]} is; names must differ")
        runs += [
            Run(path, name, seed, overrides, texts)
            for seed in seeds
            for overrides, texts in combinations
        ]
    if len({run.run_id for run in runs}) < len(runs):
        raise InputError("--set: two combinations of values have the same hash; split the sweep")
    return runs


def _combinations(axes: Sequence[Axis]) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Overrides and texts of every combination, the last axis changing fastest."""
    choices = [list(zip(axis.values, axis.texts, strict=True)) for axis in axes]
    for chosen in itertools.product(*choices):
        values, texts = ([pair[i] for pair in chosen] for i in (0, 1))
        overrides = (f"{axis.key}={value}" for axis, value in zip(axes, values, strict=True))
        yield tuple(overrides), tuple(texts)
