"""Ground-truth checks: a scenario's `expect` block against runs over several seeds."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from experiments.judge import metrics, tables
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import AnyScenario, Bound
from mapfusion.errors import InputError


def load_checked(path: Path, overrides: Sequence[str] = (), seed: int | None = None) -> AnyScenario:
    """A scenario as `load_scenario` gives it, whose `expect` block names metrics that exist.

    Raises:
        InputError: as `load_scenario`; an unknown metric, with the known ones.
    """
    scenario = load_scenario(path, overrides, seed)
    known = metrics.known_metrics([entry.name for entry in scenario.align.aligners])
    unknown = sorted(set(scenario.expect) - set(known))
    if unknown:
        raise InputError(f"{path}: expect.{unknown[0]}: unknown; known: {', '.join(known)}")
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
        return (
            math.isfinite(self.value)
            and (self.bound.min is None or self.value >= self.bound.min)
            and (self.bound.max is None or self.value <= self.bound.max)
        )

    @property
    def bound_text(self) -> str:
        """The bound as a person writes it."""
        low = "" if self.bound.min is None else f"{self.bound.min:g} <= "
        high = "" if self.bound.max is None else f" <= {self.bound.max:g}"
        return f"{low}x{high}"


def pooled_tables(results: Mapping[int, Path]) -> dict[str, pd.DataFrame]:
    """The tables that metrics read, of result folders by seed, with a column `seed`."""
    return {
        name: pd.concat(
            [
                tables.read(tables.table_path(result, name), name).assign(seed=seed)
                for seed, result in results.items()
            ],
            ignore_index=True,
        )
        for name in metrics.USED_TABLES
    }


def check(scenario: AnyScenario, results: Mapping[int, Path]) -> list[Outcome]:
    """Measure every expectation of a scenario over its results by seed."""
    pooled = pooled_tables(results)
    outcomes = []
    for name, bound in scenario.expect.items():
        per_seed = {
            seed: metrics.compute(name, {k: t[t["seed"] == seed] for k, t in pooled.items()})
            for seed in results
        }
        value = metrics.compute(name, pooled)
        outcomes.append(Outcome(scenario.name, name, value, bound, per_seed))
    return outcomes
