"""Fit the probability that an alignment is right, over worlds whose maps a sweep left in a store.

`python -m experiments.studies.refusal.fit_probability alias full posters --seeds 0..9` writes
`mapfusion/verification/fitted.py`. It prints how well the fit predicts kinds of world that were
left out.
"""

import itertools
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from experiments.evaluation.criteria import RIGHT_WITHIN_M, RIGHT_WITHIN_RAD
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.seeds import generator
from experiments.studies import refusal_cases
from experiments.studies.refusal.fitting_command import worlds_asked_for
from experiments.studies.refusal_cases import MappedWorld
from experiments.studies.refusal_rates import calibration_error
from mapfusion.align.alignment import Pairs
from mapfusion.files import write_whole
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.registration import Registration
from mapfusion.verification import fitted

# Pulls weights of scaled features towards 0: a kind of world may have none of a sign.
_RIDGE = 1e-3
# Of the evaluated iterations of worlds that repeat: maps of neighbouring ones say the same. Of
# others all, as they come upon common ground but once, and what is right then is least sure.
EVERY = 2
_TEXT = '''"""Coefficients of `probability.py`.

As `python -m experiments.studies.refusal.fit_probability` fits them.

{said}
"""

VERSION = {version}
INTERCEPT = {intercept:.3f}
WEIGHTS = ({weights})
'''


class Answers(NamedTuple):
    """Alignments that are more than chance: (n, F) features, (n,) right, (n,) kind of world."""

    features: Float
    right: Float
    kind: np.ndarray


def answers_of(worlds: Sequence[MappedWorld]) -> Answers:
    """Every aligner's refined answer at each evaluated iteration of each world."""
    rows = [row for world in worlds for row in _of_world(world)]
    features, right, kind = zip(*rows, strict=True)
    return Answers(np.array(features), np.array(right, float), np.array(kind))


def _of_world(world: MappedWorld) -> list[tuple[Float, bool, str]]:
    scenario, rows = world.scenario, []
    settings, radius_m = scenario.align, scenario.evaluate.true_pair_radius_m
    met = itertools.combinations(world.robots(), 2)
    every = EVERY if world.repeats else 1
    for (a, b), k in itertools.product(met, world.iterations[every - 1 :: every]):
        case = refusal_cases.common(a, b, k, settings.match, radius_m)
        judged = settings.judge.on(Pairs(case.map_a, case.map_b, case.pairs))
        for entry in settings.aligners:
            rng = generator(scenario.seed, "fit", world.name, a.name, b.name, k, entry.name)
            aligner = callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
            registration = Registration(aligner, settings.refinement, judge=None)
            refined = registration.register(case.map_a, case.map_b, case.pairs, rng).refined
            verdict = judged.judge(refined)
            signs = judged.features(refined) if np.isfinite(verdict.probability) else None
            if signs is not None:
                error = refined.T_a_b - case.T_true
                right = np.hypot(error[0], error[1]) < RIGHT_WITHIN_M
                right &= abs(se2.wrap(error[2])) < RIGHT_WITHIN_RAD
                rows.append((signs.vector(), bool(right), scenario.name))
    return rows


def fit(features: Float, right: Float) -> Float:
    """Intercept and weights (1 + F,) of the likeliest logistic model, weights held back a little.

    Args:
        features: (n, F).
        right: (n,) 0 or 1.
    """
    mean, scale = features.mean(axis=0), features.std(axis=0) + 1e-9
    Z = np.column_stack([np.ones(len(features)), (features - mean) / scale])
    sign = 2 * right - 1

    def cost(w: Float) -> float:
        return float(np.logaddexp(0, -sign * (Z @ w)).mean() + _RIDGE * np.sum(w[1:] ** 2))

    w = minimize(cost, np.zeros(Z.shape[1]), method="BFGS").x
    weights = w[1:] / scale
    return np.array([w[0] - weights @ mean, *weights])


def stated(model: Float, features: Float) -> Float:
    """Return the probabilities (n,) that a model (1 + F,) states."""
    return 1 / (1 + np.exp(-(model[0] + features @ model[1:])))


def left_out(answers: Answers) -> Float:
    """Return each answer's probability (n,) by a model that saw no world of its kind."""
    p = np.empty(len(answers.right))
    for kind in np.unique(answers.kind):
        own = answers.kind == kind
        p[own] = stated(fit(answers.features[~own], answers.right[~own]), answers.features[own])
    return p


def main() -> None:
    """Fit, write, and print how well it holds."""
    worlds, said = worlds_asked_for(__doc__)
    answers = answers_of(worlds)
    intercept, *weights = fit(answers.features, answers.right)
    numbers = {"n": len(answers.right), "n_right": int(answers.right.sum())}
    model = {"intercept": intercept, "weights": ", ".join(f"{w:.3f}" for w in weights)}
    of = "Of {n} alignments, {n_right} of them right, of seeds {seeds} of {worlds}."
    told = textwrap.fill(of.format(**numbers, **said), width=100)
    text = _TEXT.format(said=told, **model, version=fitted.VERSION)
    write_whole(Path(str(fitted.__file__)), lambda path: path.write_text(text, encoding="utf-8"))
    p = left_out(answers)
    brier = float(np.mean((p - answers.right) ** 2))
    error = calibration_error(p, answers.right)
    held = f"calibration error {error:.4f}, Brier score {brier:.4f}"
    sys.stdout.write(f"kinds left out one at a time: {held}\n")


if __name__ == "__main__":
    main()
