"""Fit how often regions are seen again, under right motions and under wrong ones.

`python -m experiments.studies.refusal.fit_rates full alias_light alias_light_apart --seeds 0..4`
writes `mapfusion/verification/fitted_rates.py`. Right motions are the oracle's in worlds that
do not repeat themselves; wrong ones those that two maps without a common landmark support best.
"""

import itertools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from experiments.evaluation.criteria import MERGEABLE_PAIRS
from experiments.studies import refusal_cases
from experiments.studies.refusal.fitting_command import worlds_asked_for
from experiments.studies.refusal_cases import MappedWorld
from mapfusion.align.alignment import Pairs
from mapfusion.align.oracle import Oracle
from mapfusion.files import write_whole
from mapfusion.geometry.numerics import Float
from mapfusion.verification import fitted_rates
from mapfusion.verification.likelihood import OWN, BetaRate, Rates, log_likelihood
from mapfusion.verification.regions import RegionGrid, ViewedMap, ViewedMapPair
from mapfusion.verification.rivals import BETWEEN, RepeatedLandmarks, distinct_motions
from mapfusion.verification.verdict import N_RIVALS

EVERY = 3  # of the evaluated iterations: maps of neighbouring ones say the same
_FOUR = 2, 2  # parameters of two rates
_TEXT = '''"""Rates of `likelihood.py`: two parameters of what must be seen, and two of what may be.

Written by `python -m experiments.studies.refusal.fit_rates`.

Of {n_right} regions under right motions and {n_wrong} under wrong ones, of seeds {seeds} of
{worlds}. Of the right ones {changed:.1%} are as under a wrong one.
"""

RIGHT = {right}
WRONG = {wrong}
'''

Counts = tuple[Float, Float]  # found and expected (R, 2), of what must be seen and of what may be


def regions_of(worlds: Sequence[MappedWorld]) -> tuple[Counts, Counts]:
    """Regions under right motions, and under wrong ones."""
    right, wrong = [], []
    for world in (world for world in worlds if not world.repeats):
        for case in _cases(world):
            settings = world.scenario.align
            pairs = Pairs(case.map_a, case.map_b, case.pairs)
            if case.is_true.sum() >= MERGEABLE_PAIRS:
                right_one = Oracle(settings.refinement).align(pairs, case.is_true)
                motions = [(right_one.T_a_b, right_one.inlier)]
            elif case.n_common:
                continue
            else:
                judge = settings.acceptance, settings.refinement
                found = distinct_motions(pairs, N_RIVALS, *judge)
                motions = [(each.T_a_b, each.inlier) for each in found]
            viewed_maps = ViewedMapPair(
                ViewedMap(case.map_a), ViewedMap(case.map_b), settings.evidence
            )
            none = RepeatedLandmarks.none(len(case.map_a), len(case.map_b))
            for T, inlier in motions:
                squares = RegionGrid.about(pairs.p_a[inlier], settings.evidence.region_m)
                found = viewed_maps.regions(BETWEEN, T, squares, none)
                of_kind = right if case.n_common else wrong
                of_kind.append((found.found[:, OWN], found.expected[:, OWN]))
    return _joined(right), _joined(wrong)


def _cases(world: MappedWorld) -> list[refusal_cases.Case]:
    settings, radius_m = world.scenario.align, world.scenario.evaluate.true_pair_radius_m
    two = itertools.combinations(world.robots(), 2)
    met = itertools.product(two, world.iterations[EVERY - 1 :: EVERY])
    return [refusal_cases.common(a, b, k, settings.match, radius_m) for (a, b), k in met]


def _joined(regions: list[Counts]) -> Counts:
    found, expected = zip(*regions, strict=True)
    return np.concatenate(found), np.concatenate(expected)


def fit(right: Counts, wrong: Counts) -> tuple[Rates, Rates, float]:
    """Return the most likely rates of both, and the share of right regions like wrong ones."""

    def cost_of_wrong(x: Float) -> float:
        return -float(np.sum(log_likelihood(*wrong, _rates(x))))

    of_wrong = _likeliest(cost_of_wrong, np.log([1.0, 10.0, 1.0, 10.0]))
    as_wrong = log_likelihood(*right, _rates(of_wrong))

    def cost_of_right(x: Float) -> float:
        own, changed = log_likelihood(*right, _rates(x[:4])), expit(x[4])
        both = np.logaddexp(np.log1p(-changed) + own, np.log(changed) + as_wrong)
        return -float(np.sum(both))

    of_right = _likeliest(cost_of_right, np.array([*np.log([10.0, 2.0, 2.0, 3.0]), -3.0]))
    return _rates(of_right[:4]), _rates(of_wrong), float(expit(of_right[4]))


def _rates(x: Float) -> Rates:
    must, may = np.exp(x).reshape(_FOUR)
    return BetaRate(*must), BetaRate(*may)


def _likeliest(cost: Callable[[Float], float], start: Float) -> Float:
    settings = {"maxiter": 20_000, "maxfev": 20_000, "xatol": 1e-4, "fatol": 1e-6}
    return minimize(cost, start, method="Nelder-Mead", options=settings).x


def main() -> None:
    """Fit and write."""
    worlds, said = worlds_asked_for(__doc__)
    regions = regions_of(worlds)
    right, wrong, changed = fit(*regions)
    numbers = {"n_right": len(regions[0][0]), "n_wrong": len(regions[1][0]), "changed": changed}
    rates = {"right": _written(right), "wrong": _written(wrong)}
    text = _TEXT.format(**numbers, **said, **rates)
    path = Path(str(fitted_rates.__file__))
    write_whole(path, lambda path: path.write_text(text, encoding="utf-8"))
    sys.stdout.write(text)


def _written(rates: Rates) -> str:
    return ", ".join(f"({rate.seen:.2f}, {rate.missed:.2f})" for rate in rates)


if __name__ == "__main__":
    main()
