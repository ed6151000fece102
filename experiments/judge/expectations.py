"""Ground-truth checks: a scenario's `expect` block against runs over several seeds."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.judge import metrics, tables
from experiments.judge.known_truth import why_no_truth
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import AnyScenario, Bound
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
