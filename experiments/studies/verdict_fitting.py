"""Fit the constants of the verdict to worlds whose maps a sweep left in a store.

`python -m experiments.studies.verdict_fitting WHAT WORLD... --seeds 0..4` writes one module:

- `rates`: `mapfusion/verification/fitted_rates.py`, how often regions are observed again. Right
  motions are the oracle's in worlds without repetition; wrong ones are those with most support
  between maps without a common landmark.
- `twins`: `mapfusion/verification/fitted_twins.py`, how often a region that a wrong motion lays on
  a copy is repeated completely. Wrong motions are those with most support between maps without a
  common landmark, in worlds with repetition.
"""

import argparse
import itertools
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logsumexp

from experiments.evaluation.alignment_criteria import MERGEABLE_PAIRS
from experiments.scenario.suite import parse_seeds
from experiments.studies import refusal_trial
from experiments.studies.refusal_trial import Case, MappedWorld, worlds_of
from mapfusion.align.alignment import Pairs
from mapfusion.align.refinement import Oracle
from mapfusion.files import write_atomically
from mapfusion.geometry.numerics import Float
from mapfusion.verification import fitted_rates, fitted_twins
from mapfusion.verification.likelihood import (
    COPIED,
    OWN,
    RIGHT,
    WRONG,
    BetaRate,
    Rates,
    log_likelihood,
    rates_in_part,
)
from mapfusion.verification.regions import RegionGrid, Regions, ViewedMap, ViewedMapPair
from mapfusion.verification.rivals import (
    BETWEEN,
    RepeatedLandmarks,
    distinct_motions,
    repeated_under_others,
)
from mapfusion.verification.verdict import N_RIVALS

# Step between the evaluated iterations that are used: maps of neighbouring iterations are similar.
EVERY = 3
_ROUNDS = 500  # of expectation and maximisation: the shares converge to the fourth digit
_FOUR = 2, 2  # shape of the parameters of two rates


def cases_of(world: MappedWorld, every: int) -> Iterator[tuple[int, Case]]:
    """Yield the iteration and the case of all pairs of robots, at each `every`-th iteration."""
    matching, radius_m = world.scenario.align.match, world.scenario.evaluate.true_pair_radius_m
    pairs = itertools.combinations(world.robots(), 2)
    for (a, b), k in itertools.product(pairs, world.iterations[every - 1 :: every]):
        yield k, refusal_trial.common(a, b, k, matching, radius_m)


# Regions observed again under right and under wrong motions

_RATES = '''\
"""Rates of `likelihood.py`: two parameters of what must be seen, and two of what may be.

Written by `python -m experiments.studies.verdict_fitting rates`.

Of {n_right} regions under right motions and {n_wrong} under wrong ones, of seeds {seeds} of
{worlds}. Of the right ones {changed:.1%} are as under a wrong one.
"""

RIGHT = {right}
WRONG = {wrong}
'''

Counts = tuple[Float, Float]  # found and expected (R, 2), of what must be seen and of what may be


def regions_by_motion(worlds: Sequence[MappedWorld]) -> tuple[Counts, Counts]:
    """Return the counts of regions under right motions, and under wrong ones."""
    right, wrong = list[Counts](), list[Counts]()
    for world in (world for world in worlds if not world.repeats):
        settings = world.scenario.align
        for _, case in cases_of(world, EVERY):
            pairs = Pairs(case.map_a, case.map_b, case.pairs)
            if case.is_true.sum() >= MERGEABLE_PAIRS:
                motions = [Oracle(settings.refinement).align(pairs, case.is_true)]
            elif case.n_common:
                continue
            else:
                fitting = settings.acceptance, settings.refinement
                motions = distinct_motions(pairs, N_RIVALS, *fitting)
            viewed_maps = ViewedMapPair(
                ViewedMap(case.map_a), ViewedMap(case.map_b), settings.evidence
            )
            none = RepeatedLandmarks.none(len(case.map_a), len(case.map_b))
            for motion in motions:
                grid = RegionGrid.about(pairs.p_a[motion.inlier], settings.evidence.region_m)
                regions = viewed_maps.regions(BETWEEN, motion.T_a_b, grid, none)
                counts = regions.found[:, OWN], regions.expected[:, OWN]
                (right if case.n_common else wrong).append(counts)
    return _joined(right), _joined(wrong)


def _joined(counts: list[Counts]) -> Counts:
    found, expected = zip(*counts, strict=True)
    return np.concatenate(found), np.concatenate(expected)


def fit_rates(right: Counts, wrong: Counts) -> tuple[Rates, Rates, float]:
    """Return the most likely rates of both, and the share of right regions like wrong ones."""

    def rates_of(x: Float) -> Rates:
        must, may = np.exp(x).reshape(_FOUR)
        return BetaRate(*must), BetaRate(*may)

    def likeliest(cost: Callable[[Float], float], start: Float) -> Float:
        settings = {"maxiter": 20_000, "maxfev": 20_000, "xatol": 1e-4, "fatol": 1e-6}
        return minimize(cost, start, method="Nelder-Mead", options=settings).x

    def cost_of_wrong(x: Float) -> float:
        return -float(np.sum(log_likelihood(*wrong, rates_of(x))))

    of_wrong = likeliest(cost_of_wrong, np.log([1.0, 10.0, 1.0, 10.0]))
    as_wrong = log_likelihood(*right, rates_of(of_wrong))

    def cost_of_right(x: Float) -> float:
        own, changed = log_likelihood(*right, rates_of(x[:4])), expit(x[4])
        both = np.logaddexp(np.log1p(-changed) + own, np.log(changed) + as_wrong)
        return -float(np.sum(both))

    of_right = likeliest(cost_of_right, np.array([*np.log([10.0, 2.0, 2.0, 3.0]), -3.0]))
    return rates_of(of_right[:4]), rates_of(of_wrong), float(expit(of_right[4]))


def write_rates(worlds: Sequence[MappedWorld], source: dict[str, str]) -> None:
    """Fit and write the rates."""
    regions = regions_by_motion(worlds)
    right, wrong, changed = fit_rates(*regions)
    texts = [
        ", ".join(f"({rate.seen:.2f}, {rate.missed:.2f})" for rate in rates)
        for rates in (right, wrong)
    ]
    numbers = {"n_right": len(regions[0][0]), "n_wrong": len(regions[1][0]), "changed": changed}
    _write(fitted_rates, _RATES.format(**numbers, **source, right=texts[0], wrong=texts[1]))


# Regions that are repeated completely, in part, or not at all

_TWINS = '''"""Constant of `likelihood.py`: share of repeated regions that repeat throughout.

Written by `python -m experiments.studies.verdict_fitting twins`.

Of {n} regions under wrong motions of seeds {seeds} of
{worlds}: {whole:.1%} are twins throughout, {part:.1%} in part.
"""

WHOLE = {share:.2f}
'''


def repeated_regions(worlds: Sequence[MappedWorld]) -> list[Regions]:
    """Return the regions of the best motions of maps without a common landmark."""
    regions = []
    for world in (world for world in worlds if world.repeats):
        settings = world.scenario.align
        for _, case in cases_of(world, EVERY):
            pairs = Pairs(case.map_a, case.map_b, case.pairs)
            evidence = settings.verifier.on(pairs).evidence
            if case.n_common or evidence is None:
                continue
            motions = distinct_motions(pairs, N_RIVALS, settings.acceptance, settings.refinement)
            viewed_maps = ViewedMapPair(
                ViewedMap(case.map_a), ViewedMap(case.map_b), settings.evidence
            )
            laid = [each.copies for each in evidence.motions]  # these motions' are the first
            for number, motion in enumerate(motions):
                grid = RegionGrid.about(pairs.p_a[motion.inlier], evidence.region_m)
                copies = repeated_under_others(laid, number)
                regions.append(viewed_maps.regions(BETWEEN, motion.T_a_b, grid, copies))
    return regions


def fit_twins(regions: Sequence[Regions]) -> Float:
    """Return the most likely shares (3,) of regions that repeat completely, in part, or not.

    The regions that led to the motions are left out.
    """
    log_of = []  # log likelihood (3, n) of each region's counts under the three hypotheses
    for each, part in itertools.product(regions, (OWN, COPIED)):
        rows = each.beside_best(part)
        k, n = each.found[rows, part], each.expected[rows, part]
        hypotheses = (RIGHT, rates_in_part(RIGHT), WRONG)
        log_of.append([log_likelihood(k, n, rates) for rates in hypotheses])
    log_of = np.concatenate(log_of, axis=1)
    shares = np.full(3, 1 / 3)
    for _ in range(_ROUNDS):
        of_each = np.log(shares)[:, None] + log_of
        shares = np.exp(of_each - logsumexp(of_each, axis=0)).mean(axis=1)
    return shares


def write_twins(worlds: Sequence[MappedWorld], source: dict[str, str]) -> None:
    """Fit and write the share of complete copies."""
    regions = repeated_regions(worlds)
    whole, part, _ = fit_twins(regions)
    n = sum(int(each.beside_best(kind).sum()) for each in regions for kind in (OWN, COPIED))
    numbers = {"n": n, "whole": whole, "part": part, "share": whole / (whole + part)}
    _write(fitted_twins, _TWINS.format(**numbers, **source))


def _write(module: ModuleType, text: str) -> None:
    """Replace the source of a module, and print it."""
    write_atomically(
        Path(str(module.__file__)), lambda path: path.write_text(text, encoding="utf-8")
    )
    sys.stdout.write(text)


def main() -> None:
    """Fit what the arguments of this process ask for."""
    fits = {"rates": write_rates, "twins": write_twins}
    parser = argparse.ArgumentParser(description="Fit the constants of the verdict.")
    parser.add_argument("what", choices=fits)
    parser.add_argument("worlds", nargs="+")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--results", type=Path, default=Path("results"))
    args = parser.parse_args()
    worlds = worlds_of(args.worlds, parse_seeds(args.seeds), args.results)
    source = {"seeds": args.seeds.replace("..", " to "), "worlds": ", ".join(args.worlds)}
    fits[args.what](worlds, source)


if __name__ == "__main__":
    main()
