"""Fit how often a twin, where a wrong motion lays a region on its like, is so throughout.

`python -m experiments.studies.refusal.fit_twins posters_apart alias_posters_apart --seeds 0..4`
writes `mapfusion/verification/fitted_twins.py`. Wrong motions are those that two maps
without a common landmark support best, in worlds that repeat themselves.
"""

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.special import logsumexp

from experiments.studies import refusal_cases
from experiments.studies.refusal.fitting_command import worlds_asked_for
from experiments.studies.refusal_cases import MappedWorld
from mapfusion.align.alignment import Pairs
from mapfusion.files import write_whole
from mapfusion.geometry.numerics import Float
from mapfusion.verification import fitted_twins
from mapfusion.verification.likelihood import COPIED, OWN, PART, RIGHT, WRONG, log_likelihood
from mapfusion.verification.regions import RegionGrid, Regions, ViewedMap, ViewedMapPair
from mapfusion.verification.rivals import BETWEEN, distinct_motions, repeated_under_others
from mapfusion.verification.verdict import N_RIVALS

EVERY = 3  # of the evaluated iterations: maps of neighbouring ones say the same
_ROUNDS = 500  # of expectation and maximisation: shares have settled to the fourth digit
_TEXT = '''"""Constant of `likelihood.py`: share of repeated regions that repeat throughout.

Written by `python -m experiments.studies.refusal.fit_twins`.

Of {n} regions under wrong motions of seeds {seeds} of
{worlds}: {whole:.1%} are twins throughout, {part:.1%} in part.
"""

WHOLE = {share:.2f}
'''


def regions_of(worlds: Sequence[MappedWorld]) -> list[Regions]:
    """Return the regions of the best motions of maps without a common landmark."""
    found = []
    for world in (world for world in worlds if world.repeats):
        settings, radius_m = world.scenario.align, world.scenario.evaluate.true_pair_radius_m
        two = itertools.combinations(world.robots(), 2)
        for (a, b), k in itertools.product(two, world.iterations[EVERY - 1 :: EVERY]):
            case = refusal_cases.common(a, b, k, settings.match, radius_m)
            pairs = Pairs(case.map_a, case.map_b, case.pairs)
            evidence = settings.judge.on(pairs).evidence
            if case.n_common or evidence is None:
                continue
            motions = distinct_motions(pairs, N_RIVALS, settings.acceptance, settings.refinement)
            viewed_maps = ViewedMapPair(
                ViewedMap(case.map_a), ViewedMap(case.map_b), settings.evidence
            )
            laid = [each.copies for each in evidence.motions]  # these motions' are the first
            for number, each in enumerate(motions):
                squares = RegionGrid.about(pairs.p_a[each.inlier], evidence.region_m)
                copies = repeated_under_others(laid, number)
                found.append(viewed_maps.regions(BETWEEN, each.T_a_b, squares, copies))
    return found


def fit(regions: Sequence[Regions]) -> Float:
    """Return the most likely shares (3,) of regions that repeat fully, in part, or not.

    Without the regions by which the motions were found.
    """
    by_part = [_likelihoods(each, part) for each in regions for part in (OWN, COPIED)]
    log_of = np.concatenate(by_part, axis=1)
    shares = np.full(3, 1 / 3)
    for _ in range(_ROUNDS):
        of_each = np.log(shares)[:, None] + log_of
        shares = np.exp(of_each - logsumexp(of_each, axis=0)).mean(axis=1)
    return shares


def _likelihoods(regions: Regions, part: int) -> Float:
    """Log (3, n) of each region's counts if it is a twin throughout, in part, not at all."""
    rows = regions.beside_best(part)
    k, n = regions.found[rows, part], regions.expected[rows, part]
    return np.array([log_likelihood(k, n, rates) for rates in (RIGHT, PART, WRONG)])


def main() -> None:
    """Fit and write."""
    worlds, said = worlds_asked_for(__doc__)
    regions = regions_of(worlds)
    whole, part, _ = fit(regions)
    n = sum(int(each.beside_best(kind).sum()) for each in regions for kind in (OWN, COPIED))
    numbers = {"n": n, "whole": whole, "part": part, "share": whole / (whole + part)}
    text = _TEXT.format(**numbers, **said)
    path = Path(str(fitted_twins.__file__))
    write_whole(path, lambda path: path.write_text(text, encoding="utf-8"))
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
