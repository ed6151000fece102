"""Checks of arguments and settings; error messages name the argument."""

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Integral, Real
from types import NoneType
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np
from annotated_types import BaseMetadata, Ge, GroupedMetadata, Le

from mapfusion.errors import OutOfRangeError

# Above these limits, rounding errors of squared distances and determinants are too large.
LARGEST_POSITION_M = 1e7
LARGEST_SIGMA_M = 1e5


def require_finite(name: str, values: np.ndarray) -> None:
    """Raise ValueError when `values` holds NaN or infinity."""
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: contains NaN or infinity")


def require_shape(name: str, values: np.ndarray, shape: tuple[int | None, ...]) -> None:
    """Raise ValueError when `values` has another shape; None matches any length."""
    fits = values.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(values.shape, shape, strict=True)
    )
    if not fits:
        wanted = tuple("N" if n is None else n for n in shape)
        raise ValueError(f"{name}: shape is {values.shape}, expected {wanted}".replace("'", ""))


def require_points(position_m: np.ndarray, covariance_m2: np.ndarray, planar: bool) -> None:
    """Raise ValueError for points (N, 3) that cannot be used; the message names the row.

    Coordinates and covariances (N, 3, 3) are limited in size, and covariances must be positive
    definite. The z coordinate of planar data is not checked.
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
        # the smallest eigenvalue that differs from zero in 64 bits
        low, high = np.linalg.eigvalsh(used)[:, [0, -1]].T
        _refuse("covariance_m2", low <= np.finfo(float).eps * high, "not positive definite")


def require_no_twins(name: str, *columns: np.ndarray) -> None:
    """Raise ValueError when two of N rows are equal in all columns (N,) or (N, k)."""
    rows = np.column_stack(columns)
    # a column without repetitions is enough, and far faster than sorting rows by all columns
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
class Unit(BaseMetadata):
    """Unit of a setting, as an annotation that JSON schemas show.

    Attributes:
        unit: symbol or plural noun; "1" for shares and factors.
    """

    unit: str

    def __get_pydantic_json_schema__(self, core_schema: Any, handler: Any) -> dict[str, Any]:
        """Add the unit to the JSON schema; pydantic calls this method."""
        return handler(core_schema) | {"unit": self.unit}


@dataclass(frozen=True)
class Range(GroupedMetadata):
    """Range and unit of a numeric setting: `Annotated[float, Range(0, 5, "m")]`.

    The annotation consists of `annotated_types` constraints, which pydantic reads.
    `require_in_range` checks them without pydantic. The limits are those of the mathematics and of
    memory. Other limits are a hundred times larger than useful values, so that squares and
    products of settings stay finite.

    Attributes:
        low: the smallest allowed value.
        high: the largest allowed value.
        unit: symbol or plural noun; "1" for shares and factors.
    """

    low: float
    high: float
    unit: str

    def __iter__(self) -> Iterator[BaseMetadata]:
        """Yield the constraints."""
        yield Ge(self.low)
        yield Le(self.high)
        yield Unit(self.unit)

    def problem(self, number: float) -> str:
        """Return a message for a number outside the range; empty for a number inside."""
        if self.low <= number <= self.high:
            return ""
        unit = "" if self.unit == "1" else f" {self.unit}"
        finite = "" if math.isfinite(number) else "finite and "
        return f"is {number}, must be {finite}in [{self.low:.15g}, {self.high:.15g}]{unit}"


# The chi-square quantile of 1 is infinite; no distance passes the quantile of 0.
Probability = Annotated[float, Range(1e-6, 1 - 1e-15, "1")]


def require_in_range(settings: object) -> None:
    """Raise OutOfRangeError if a setting of a dataclass is outside its `Range`."""
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
    """Return the annotations of all settings that have a range."""
    hints = get_type_hints(settings, include_extras=True)
    return {name: hint for name, hint in hints.items() if _declares(hint)}


def _declares(hint: Any) -> bool:
    """Return True if an annotation or a part of it has a range."""
    own = any(isinstance(each, Range) for each in getattr(hint, "__metadata__", ()))
    return own or any(map(_declares, get_args(hint)))


def _require_as_declared(name: str, value: Any, hint: Any) -> None:
    """Raise OutOfRangeError if a value, or an item of a value, is outside the range of its hint."""
    parts = get_args(hint)
    if hasattr(hint, "__metadata__"):
        for bounds in hint.__metadata__:
            if not isinstance(bounds, Range):
                continue
            is_integer = hint.__origin__ is int
            kind: Any = Integral if is_integer else Real
            if isinstance(value, bool) or not isinstance(value, kind):
                expected = "an integer" if is_integer else "a number"
                raise OutOfRangeError(name, f"is {value!r}, expected {expected}")
            if problem := bounds.problem(value):
                raise OutOfRangeError(name, problem)
        _require_as_declared(name, value, parts[0])
    elif isinstance(value, tuple | list):
        # items of a tuple have one range each, or the same range as in a list
        one_each = len(parts) == len(value) and parts[-1] is not ...
        each = parts if one_each else parts[:1] * len(value)
        for i, (item, own) in enumerate(zip(value, each, strict=True)):
            _require_as_declared(f"{name}.{i}", item, own)
    elif value is not None and parts:
        _require_as_declared(name, value, next(each for each in parts if each is not NoneType))


def require_at_least(least: float, settings: object, *names: str) -> None:
    """Raise OutOfRangeError if one of the named settings is below `least`."""
    for name in names:
        if not getattr(settings, name) >= least:
            raise OutOfRangeError(name, f"is {getattr(settings, name)}, must be at least {least:g}")
