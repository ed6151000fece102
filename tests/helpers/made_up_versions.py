"""Sweeps of one and the same runs, as two versions of the program make them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.study.statistics.judged_maps import ERROR_COLUMNS
from tests.helpers.made_up_runs import tables_of, write_sweep

Tables = dict[str, pd.DataFrame]


def two_sweeps(
    folder: Path, change: Callable[[int, Tables], Tables], seeds: int = 12
) -> tuple[Path, Path]:
    """The same runs, and what another version makes of them."""
    made = {seed: tables_of(seed) for seed in range(seeds)}
    changed = {seed: change(seed, {k: t.copy() for k, t in made[seed].items()}) for seed in made}
    a = write_sweep(folder / "a", range(seeds), made=made)
    return a, write_sweep(folder / "b", range(seeds), made=changed)


def scaled(factor: float, aligner: str, scatter: float = 0.0) -> Callable[[int, Tables], Tables]:
    def change(seed: int, made: Tables) -> Tables:
        rng = np.random.default_rng(900 + seed)
        own = made["errors"]["aligner"] == aligner
        factors = factor * np.exp(scatter * rng.normal(size=(int(own.sum()), 1)))
        made["errors"].loc[own, list(ERROR_COLUMNS)] *= factors
        return made

    return change
