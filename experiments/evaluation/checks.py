"""Checks of the metrics that scenarios expect, over runs with several seeds."""

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
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import AnyScenario, Bound, Recording
from experiments.scenario.suite import scenarios_of
from mapfusion.errors import InputError
from mapfusion.robot_log import TRUTH_TABLES
from mapfusion.tables import table_path


def load_checked(
    path: Path,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    content: dict[str, Any] | None = None,
) -> AnyScenario:
    """Load a scenario whose expected metrics can be computed; arguments as of `load_scenario`.

    Raises:
        InputError: the scenario is wrong, or an expected metric needs a truth that is unknown.
    """
    scenario = load_scenario(path, overrides, seed, content)
    needing_truth = [name for name in scenario.expect if name not in metrics.WITHOUT_TRUTH]
    if needing_truth and (reason := why_no_truth(scenario)):
        name = needing_truth[0]
        raise InputError(f"{path}: expect.{name}: {reason}; leave `expect` out, or add the file")
    return scenario


@dataclass(frozen=True)
class Outcome:
    """Value of an expected metric.

    Attributes:
        scenario: name of the scenario.
        metric: name of the metric.
        value: value over all seeds.
        bound: range of the expectation.
        per_seed: values by seed.
    """

    scenario: str
    metric: str
    value: float
    bound: Bound
    per_seed: Mapping[int, float]

    @property
    def passed(self) -> bool:
        """True if the value is finite and within the bound."""
        low = -math.inf if self.bound.min is None else self.bound.min
        high = math.inf if self.bound.max is None else self.bound.max
        return math.isfinite(self.value) and low <= self.value <= high

    @property
    def bound_text(self) -> str:
        """Bound as an inequality of x."""
        low = "" if self.bound.min is None else f"{self.bound.min:g} <= "
        high = "" if self.bound.max is None else f" <= {self.bound.max:g}"
        return f"{low}x{high}"


def check(scenario: AnyScenario, results: Mapping[int, Path]) -> list[Outcome]:
    """Compute the expected metrics of a scenario from its result folders by seed."""
    by_seed: dict[int, dict[str, pd.DataFrame]] = {seed: {} for seed in results}
    for seed, result in results.items():
        for name in metrics.USED_TABLES:
            rows = tables.read(tables.table_path(result, name), name)
            by_seed[seed][name] = rows.assign(seed=seed)
    parts = {name: [own[name] for own in by_seed.values()] for name in metrics.USED_TABLES}
    pooled = {name: pd.concat(each, ignore_index=True) for name, each in parts.items()}
    outcomes = []
    for name, bound in scenario.expect.items():
        per_seed = {seed: metrics.compute(name, own) for seed, own in by_seed.items()}
        value = metrics.compute(name, pooled)
        outcomes.append(Outcome(scenario.name, name, value, bound, per_seed))
    return outcomes


@dataclass(frozen=True)
class CheckedScenario:
    """Outcomes of a scenario, or an error.

    A scenario without outcomes, error and times was not run, because another one cannot be read.

    Attributes:
        scenario: name of the scenario.
        outcomes: values of the expected metrics.
        error: message if the scenario cannot be read or run; the error belongs to the last seed.
        elapsed_s: wall-clock time by seed, of all runs that were started.
        unmerged: seeds whose maps should have been merged but were not.
    """

    scenario: str
    outcomes: Sequence[Outcome] = ()
    error: str = ""
    elapsed_s: Mapping[int, float] = field(default_factory=dict)
    unmerged: Mapping[int, NothingMerged] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """True if all runs finished, all bounds hold and maps were merged where possible."""
        ran = bool(self.elapsed_s) and not self.error
        return ran and not self.unmerged and all(outcome.passed for outcome in self.outcomes)


def check_all(
    words: Sequence[str],
    seeds: Sequence[int],
    overrides: Sequence[str],
    run: Callable[[AnyScenario], Path],
) -> Iterator[CheckedScenario]:
    """Run and check scenarios.

    No scenario runs if one of them cannot be read. A failed run ends its own scenario. Errors
    other than `InputError` are raised again after the result of the scenario was yielded.

    Args:
        words: files, names or tags of scenarios.
        seeds: seeds of the runs of each scenario.
        overrides: entries `key.sub=value` that replace values of the scenarios.
        run: runs a scenario and returns its result folder.
    """
    loaded: list[CheckedScenario | list[AnyScenario]] = []
    for word in words:
        try:
            paths = scenarios_of([word])
        except InputError as error:
            loaded.append(CheckedScenario(word, error=str(error)))
            continue
        for path in paths:
            try:
                loaded.append([load_checked(path, overrides, seed) for seed in seeds])
            except InputError as error:
                loaded.append(CheckedScenario(path.stem, error=str(error)))
    unreadable = any(isinstance(each, CheckedScenario) for each in loaded)
    for each in loaded:
        if isinstance(each, CheckedScenario):
            yield each
        elif unreadable:
            yield CheckedScenario(each[0].name)
        else:
            yield from _run_and_check(each, run)


def _run_and_check(
    runs: Sequence[AnyScenario], run: Callable[[AnyScenario], Path]
) -> Iterator[CheckedScenario]:
    """Yield the outcomes of one scenario, given for each of its seeds."""
    name, folders, elapsed_s = runs[0].name, dict[int, Path](), dict[int, float]()
    try:
        for scenario in runs:
            started_s = time.perf_counter()
            try:
                folders[scenario.seed] = run(scenario)
            finally:
                elapsed_s[scenario.seed] = time.perf_counter() - started_s
        outcomes, unmerged = check(runs[0], folders), dict[int, NothingMerged]()
        if MERGED_ROBOTS not in runs[0].expect:  # else the scenario itself bounds this number
            for seed, folder in folders.items():
                nothing = nothing_merged(folder)
                if nothing is not None and nothing.failed:
                    unmerged[seed] = nothing
    except InputError as error:
        yield CheckedScenario(name, error=str(error), elapsed_s=elapsed_s)
    except Exception as error:
        yield CheckedScenario(name, error=f"{type(error).__name__}: {error}", elapsed_s=elapsed_s)
        raise
    else:
        yield CheckedScenario(name, outcomes, elapsed_s=elapsed_s, unmerged=unmerged)


def why_no_truth(scenario: AnyScenario) -> str:
    """Return a text about the first log of a scenario without truth; empty if all have truth.

    Robots are evaluated together, because alignments concern the maps of two robots.
    """
    logs = map(Path, scenario.logs) if isinstance(scenario, Recording) else ()
    for log in logs:
        lacking = [name for name in TRUTH_TABLES if not table_path(log, name).is_file()]
        if lacking and log.is_dir():
            return f"no truth is known: {log} has no {lacking[0]}.parquet or .csv"
    return ""
