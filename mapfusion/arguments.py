"""Arguments of the library's functions, refused with the argument's name."""

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


def require_positive(parameters: object, *names: str) -> None:
    """Raise ValueError naming the first of these attributes that is not above 0."""
    for name in names:
        if not getattr(parameters, name) > 0:
            raise ValueError(f"{name}: must be positive")


def require_not_negative(parameters: object, *names: str) -> None:
    """Raise ValueError naming the first of these attributes that is below 0, or NaN."""
    for name in names:
        if not getattr(parameters, name) >= 0:
            raise ValueError(f"{name}: must not be negative")


def require_between_0_and_1(parameters: object, *names: str) -> None:
    """Raise ValueError naming the first of these attributes that is not inside (0, 1)."""
    for name in names:
        if not 0 < getattr(parameters, name) < 1:
            raise ValueError(f"{name}: must lie between 0 and 1")
