"""What counts as a correct result."""

import pandas as pd

# Placeholder until experiments.statistics is there.
TRANSLATION_M, ROTATION_RAD = 0.5, 0.1


def correct(errors: pd.DataFrame) -> pd.Series:
    """Whether each refined estimate is right; one that was never found is not."""
    return (errors["refined_translation_error_m"] <= TRANSLATION_M) & (
        errors["refined_rotation_error_rad"].abs() <= ROTATION_RAD
    )
