"""What counts as correct, and the intervals of success rates: a thin call to the statistics."""

import math

import pandas as pd

# Placeholder until experiments.statistics is there.
TRANSLATION_M, ROTATION_RAD = 0.5, 0.1


def correct(errors: pd.DataFrame) -> pd.Series:
    """Whether each refined estimate is right; one that was never found is not."""
    return (errors["refined_translation_error_m"] <= TRANSLATION_M) & (
        errors["refined_rotation_error_rad"].abs() <= ROTATION_RAD
    )


def wilson(successes: float, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson interval."""
    from scipy.stats import norm

    z = float(norm.ppf(0.5 + confidence / 2))
    share = successes / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(
        share * (1 - share) / trials + z * z / (4 * trials**2)
    )
    return max(0.0, centre - half), min(1.0, centre + half)
