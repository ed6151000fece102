"""Arguments and settings of the library, refused with their names."""

import numpy as np


def require_finite(name: str, values: np.ndarray) -> None:
    """Raise ValueError when `values` holds NaN or infinity."""
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: contains NaN or infinity")


def require_shape(name: str, values: np.ndarray, shape: tuple[int | None, ...]) -> None:
    """Raise ValueError when `values` has another shape; None stands for any length."""
    fits = values.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(values.shape, shape, strict=True)
    )
    if not fits:
        wanted = tuple("N" if n is None else n for n in shape)
        raise ValueError(f"{name}: shape is {values.shape}, expected {wanted}".replace("'", ""))


def require_above(least: float, settings: object, *names: str) -> None:
    """Raise ValueError when one of these settings is not above `least`; NaN is not."""
    for name in names:
        if not getattr(settings, name) > least:
            raise ValueError(f"{name}: is {getattr(settings, name)}, must be above {least:g}")


def require_at_least(least: float, settings: object, *names: str) -> None:
    """Raise ValueError when one of these settings is not `least` or more."""
    for name in names:
        if not getattr(settings, name) >= least:
            raise ValueError(f"{name}: is {getattr(settings, name)}, must be at least {least:g}")


def require_between(low: float, high: float, settings: object, *names: str) -> None:
    """Raise ValueError when one of these settings is not strictly between two numbers."""
    for name in names:
        if not low < getattr(settings, name) < high:
            value = getattr(settings, name)
            raise ValueError(f"{name}: is {value}, must be above {low:g} and below {high:g}")
