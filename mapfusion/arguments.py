"""Arguments and settings of the library, refused with their names."""

import numpy as np

# Beyond these the squares and determinants behind a gate lose the digits that it needs.
LARGEST_POSITION_M = 1e7
LARGEST_SIGMA_M = 1e5


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


def require_points(position_m: np.ndarray, covariance_m2: np.ndarray, planar: bool) -> None:
    """Raise ValueError for points (N, 3) that nothing can be computed with, naming the row.

    They and their covariances (N, 3, 3; of planar data without z) must be of a size that a robot
    measures, the covariances positive definite, and no point may be there twice.
    """
    size = 2 if planar else 3
    used = covariance_m2[:, :size, :size]
    far = (np.abs(position_m) > LARGEST_POSITION_M).any(1)
    _refuse("position_m", far, f"above {LARGEST_POSITION_M:g} m")
    vague = (np.abs(used) > LARGEST_SIGMA_M**2).any((1, 2))
    _refuse("covariance_m2", vague, f"above {LARGEST_SIGMA_M:g} m squared")
    try:
        np.linalg.cholesky(used)
    except np.linalg.LinAlgError:
        # the limit of what a decomposition of 64 bits can tell from zero
        low, high = np.linalg.eigvalsh(used)[:, [0, -1]].T
        _refuse("covariance_m2", low <= np.finfo(float).eps * high, "not positive definite")


def require_no_twins(name: str, *columns: np.ndarray) -> None:
    """Raise ValueError when two of N rows are the same in all columns (N,) or (N, k)."""
    rows = np.column_stack(columns)
    order = np.lexsort(rows.T)
    same = (rows[order[1:]] == rows[order[:-1]]).all(1)
    if same.any():
        pair = sorted(order[np.flatnonzero(same)[0] :][:2].tolist())
        raise ValueError(f"{name}: row {pair[1]} repeats row {pair[0]}, remove one of them")


def _refuse(name: str, wrong: np.ndarray | np.bool, what: str) -> None:
    if np.any(wrong):
        raise ValueError(f"{name}: {what} in row {np.flatnonzero(wrong)[0]}")


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
