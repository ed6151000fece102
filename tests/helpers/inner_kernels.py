"""Kernels that only kernels call, called by tests."""

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit

from mapfusion.geometry.numerics import source_of


@cache
def from_python(inner: Any) -> Callable[..., Any]:
    """The same function, compiled with what callers in Python need."""
    return njit(source_of(inner))
