"""Checks of arguments and settings; a refusal names the argument."""

import functools
import math
from dataclasses import dataclass
from numbers import Integral, Real
from types import NoneType
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np

from mapfusion.errors import OutOfRangeError

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
    # one column that repeats nothing says it: to put rows in order by all takes far longer
    if any(len(np.unique(column)) == len(rows) for column in rows.T[::-1]):
        return
    order = np.lexsort(rows.T)
    same = (rows[order[1:]] == rows[order[:-1]]).all(1)
    if same.any():
        pair = sorted(order[np.flatnonzero(same)[0] :][:2].tolist())
        raise ValueError(f"{name}: row {pair[1]} repeats row {pair[0]}, remove one of them")


def _refuse(name: str, wrong: np.ndarray | np.bool, what: str) -> None:
    if np.any(wrong):
        raise ValueError(f"{name}: {what} in row {np.flatnonzero(wrong)[0]}")


@dataclass(frozen=True)
class Range:
    """Values that a numeric setting may have, and its unit: `Annotated[float, Range(0, 5, "m")]`.

    Stated once, in the annotation: `require_in_range` refuses what lies outside (NaN does), and
    JSON schemas tell it. The ends are what mathematics and memory allow, and where these allow all,
    a hundred times beyond anything of use: so that squares and products of settings stay numbers.

    Attributes:
        low: the least value, itself allowed.
        high: the largest value, itself allowed.
        unit: as people write it; "1" of shares, factors and numbers of things.
    """

    low: float
    high: float
    unit: str

    def problem(self, number: float) -> str:
        """Return what is wrong with a number outside the range; empty for one inside."""
        if self.low <= number <= self.high:
            return ""
        unit = "" if self.unit == "1" else f" {self.unit}"
        finite = "" if math.isfinite(number) else "finite and "
        return f"is {number}, must be {finite}in [{self.low:.15g}, {self.high:.15g}]{unit}"

    def __get_pydantic_json_schema__(self, core_schema: Any, handler: Any) -> dict[str, Any]:
        """What pydantic asks for; nothing of it is needed here."""
        return handler(core_schema) | {"minimum": self.low, "maximum": self.high, "unit": self.unit}


# Of 1 a chi-square quantile is infinite, of 0 nothing passes.
Probability = Annotated[float, Range(1e-6, 1 - 1e-15, "1")]


def require_in_range(settings: object) -> None:
    """Raise OutOfRangeError for the settings of a class outside the `Range` they declare."""
    wrong = list[OutOfRangeError]()
    for name, hint in _ranged(type(settings)).items():
        try:
            _require_as_declared(name, getattr(settings, name), hint)
        except OutOfRangeError as error:
            wrong.append(error)
    if wrong:
        first, *others = ((error.name, error.problem) for error in wrong)
        raise OutOfRangeError(*first, others)


@functools.cache
def _ranged(settings: type) -> dict[str, Any]:
    """Annotations of all settings that declare a range."""
    hints = get_type_hints(settings, include_extras=True)
    return {name: hint for name, hint in hints.items() if _declares(hint)}


def _declares(hint: Any) -> bool:
    own = any(isinstance(each, Range) for each in getattr(hint, "__metadata__", ()))
    return own or any(map(_declares, get_args(hint)))


def _require_as_declared(name: str, value: Any, hint: Any) -> None:
    parts = get_args(hint)
    if hasattr(hint, "__metadata__"):
        for bounds in hint.__metadata__:
            if isinstance(bounds, Range):
                _require_inside(name, value, hint.__origin__, bounds)
        _require_as_declared(name, value, parts[0])
    elif isinstance(value, tuple | list):
        # a tuple's items have a range each, or one for all as those of a list have
        one_each = len(parts) == len(value) and parts[-1] is not ...
        each = parts if one_each else parts[:1] * len(value)
        for i, (item, own) in enumerate(zip(value, each, strict=True)):
            _require_as_declared(f"{name}.{i}", item, own)
    elif value is not None and parts:
        _require_as_declared(name, value, next(each for each in parts if each is not NoneType))


def _require_inside(name: str, number: Any, kind: Any, bounds: Range) -> None:
    wanted: Any = Integral if kind is int else Real
    called = "an integer" if kind is int else "a number"
    if isinstance(number, bool) or not isinstance(number, wanted):
        raise OutOfRangeError(name, f"is {number!r}, expected {called}")
    if problem := bounds.problem(number):
        raise OutOfRangeError(name, problem)


def require_at_least(least: float, settings: object, *names: str) -> None:
    """Raise OutOfRangeError when one of these settings is not `least` or more."""
    for name in names:
        if not getattr(settings, name) >= least:
            raise OutOfRangeError(name, f"is {getattr(settings, name)}, must be at least {least:g}")
