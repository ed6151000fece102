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
    """A scenario as `load_scenario` gives it; raises InputError also for unknown metrics."""
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


def check(scenario: AnyScenario, results: Mapping[int, Path]) -> list[Outcome]:
    """Measure every expectation of a scenario over its results by seed."""
    own = {
        seed: {
            name: tables.read(tables.table_path(result, name), name).assign(seed=seed)
            for name in metrics.USED_TABLES
        }
        for seed, result in results.items()
    }
    pooled = {
        name: pd.concat([held[name] for held in own.values()], ignore_index=True)
        for name in metrics.USED_TABLES
    }
    return [
        Outcome(
            scenario.name,
            name,
            metrics.compute(name, pooled),
            bound,
            {seed: metrics.compute(name, held) for seed, held in own.items()},
        )
        for name, bound in scenario.expect.items()
    ]
