"""Checks of arguments and settings; error messages name the argument."""

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Integral, Real
from types import NoneType
from typing import Annotated, Any, get_args, get_type_hints

from annotated_types import BaseMetadata, Ge, GroupedMetadata, Le

from mapfusion.errors import OutOfRangeError


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
    return {name: hint for name, hint in hints.items() if _has_range(hint)}


def _has_range(hint: Any) -> bool:
    """Return True if a type annotation, or one of its type arguments, has a `Range`."""
    has_own_range = any(
        isinstance(annotation, Range) for annotation in getattr(hint, "__metadata__", ())
    )
    return has_own_range or any(map(_has_range, get_args(hint)))


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
