"""Ground-truth checks: `expect` blocks of scenarios held against runs over several seeds."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.evaluation import metrics, tables
from experiments.evaluation.criteria import NothingMerged, nothing_merged
from experiments.evaluation.metrics import MERGED_ROBOTS
from experiments.evaluation.truth import why_no_truth
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import AnyScenario, Bound
from experiments.scenario.suite import scenarios_of
from mapfusion.errors import InputError


def load_checked(
    path: Path,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    content: dict[str, Any] | None = None,
) -> AnyScenario:
    """A scenario as `load_scenario` gives it.

    Raises InputError also where the truth is unknown that an expected metric needs.
    """
    scenario = load_scenario(path, overrides, seed, content)
    judged = [name for name in scenario.expect if name not in metrics.WITHOUT_TRUTH]
    if judged and (reason := why_no_truth(scenario)):
        name = judged[0]
        raise InputError(f"{path}: expect.{name}: {reason}; leave `expect` out, or add the file")
    return scenario


@dataclass(frozen=True)
class Outcome:
    """One expectation, measured."""

    scenario: str
    metric: str
    value: float
    bound: Bound
    per_seed: Mapping[int, float]

    @property
    def passed(self) -> bool:
        """Whether the value was measured and lies within the bound."""
        low = -math.inf if self.bound.min is None else self.bound.min
        high = math.inf if self.bound.max is None else self.bound.max
        return math.isfinite(self.value) and low <= self.value <= high

    @property
    def bound_text(self) -> str:
        """The bound as a person writes it."""
        low = "" if self.bound.min is None else f"{self.bound.min:g} <= "
        high = "" if self.bound.max is None else f" <= {self.bound.max:g}"
        return f"{low}x{high}"


def check(scenario: AnyScenario, results: Mapping[int, Path]) -> list[Outcome]:
    """Measure every expectation of a scenario over its results by seed."""
    own: dict[int, dict[str, pd.DataFrame]] = {seed: {} for seed in results}
    for seed, result in results.items():
        for name in metrics.USED_TABLES:
            rows = tables.read(tables.table_path(result, name), name)
            own[seed][name] = rows.assign(seed=seed)
    parts = {name: [held[name] for held in own.values()] for name in metrics.USED_TABLES}
    pooled = {name: pd.concat(each, ignore_index=True) for name, each in parts.items()}
    outcomes = []
    for name, bound in scenario.expect.items():
        per_seed = {seed: metrics.compute(name, held) for seed, held in own.items()}
        value = metrics.compute(name, pooled)
        outcomes.append(Outcome(scenario.name, name, value, bound, per_seed))
    return outcomes


@dataclass(frozen=True)
class CheckedScenario:
    """A scenario's outcomes, or the error that kept it from having any.

    `elapsed_s` are seconds on the clock by seed, of all that were begun: an error is of the last.
    Without any of the three it was not begun, since another scenario cannot be read. `unmerged` are
    the seeds whose maps were not merged though they should have been.
    """

    scenario: str
    outcomes: Sequence[Outcome] = ()
    error: str = ""
    elapsed_s: Mapping[int, float] = field(default_factory=dict)
    unmerged: Mapping[int, NothingMerged] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether it ran, all that it expects holds, and what can be merged was."""
        ran = bool(self.elapsed_s) and not self.error
        return ran and not self.unmerged and all(outcome.passed for outcome in self.outcomes)


def check_all(
    words: Sequence[str],
    seeds: Sequence[int],
    overrides: Sequence[str],
    run: Callable[[AnyScenario], Path],
) -> Iterator[CheckedScenario]:
    """Check scenarios asked for by file, name or tag; `run` gives the result folder of one.

    Where one cannot be read none is run. What else goes wrong ends its own scenario alone; if it
    is no `InputError`, it is raised again once it is told.
    """
    read = [each for word in words for each in _read(word, seeds, overrides)]
    if any(isinstance(each, CheckedScenario) for each in read):
        for each in read:
            untold = isinstance(each, CheckedScenario)
            yield each if untold else CheckedScenario(each[0].name)
        return
    for runs in read:
        assert not isinstance(runs, CheckedScenario)
        yield from _checked(runs, run)


def _read(
    word: str, seeds: Sequence[int], overrides: Sequence[str]
) -> Iterator[CheckedScenario | list[AnyScenario]]:
    """For each scenario that a word stands for its runs by seed, or why it cannot be read."""
    try:
        paths = scenarios_of([word])
    except InputError as error:
        yield CheckedScenario(word, error=str(error))
        return
    for path in paths:
        try:
            yield [load_checked(path, overrides, seed) for seed in seeds]
        except InputError as error:
            yield CheckedScenario(path.stem, error=str(error))


def _checked(
    runs: Sequence[AnyScenario], run: Callable[[AnyScenario], Path]
) -> Iterator[CheckedScenario]:
    """One scenario over its seeds."""
    name, folders, elapsed_s = runs[0].name, dict[int, Path](), dict[int, float]()
    try:
        for scenario in runs:
            started_s = time.perf_counter()
            try:
                folders[scenario.seed] = run(scenario)
            finally:
                elapsed_s[scenario.seed] = time.perf_counter() - started_s
        outcomes, unmerged = check(runs[0], folders), _unmerged(runs[0], folders)
    except InputError as error:
        yield CheckedScenario(name, error=str(error), elapsed_s=elapsed_s)
    except Exception as error:
        yield CheckedScenario(name, error=f"{type(error).__name__}: {error}", elapsed_s=elapsed_s)
        raise
    else:
        yield CheckedScenario(name, outcomes, elapsed_s=elapsed_s, unmerged=unmerged)


def _unmerged(scenario: AnyScenario, folders: Mapping[int, Path]) -> dict[int, NothingMerged]:
    """Of the runs by seed those that fail by having merged nothing.

    A scenario that bounds the number of merged robots has said itself what is to come out.
    """
    if MERGED_ROBOTS in scenario.expect:
        return {}
    found = {seed: nothing_merged(folder) for seed, folder in folders.items()}
    return {seed: each for seed, each in found.items() if each is not None and each.failed}
