"""Kernels as the Python that they are written in: NumPy looks at each index before it is used."""

import functools
from collections.abc import Callable
from typing import Any

import numba
import numba.extending

# What an instruction of the processor does, in Python.
_INSTRUCTIONS: dict[str, Callable[[Any], int]] = {
    "trailing_zeros": lambda word: (int(word) & -int(word)).bit_length() - 1,
    "popcount": lambda word: int(word).bit_count(),
}


def interpret_kernels() -> dict[str, int]:
    """Have Numba compile nothing that is imported from here on.

    Returns how often each kernel, by its full name, was called; it goes on counting.
    """
    calls: dict[str, int] = {}

    def counted(kernel: Callable[..., Any]) -> Callable[..., Any]:
        name = f"{kernel.__module__}.{kernel.__name__}"
        calls[name] = 0

        @functools.wraps(kernel)
        def call(*arguments: Any, **named: Any) -> Any:
            calls[name] += 1
            return kernel(*arguments, **named)

        return call

    def njit(kernel: Callable[..., Any] | None = None, **_: Any) -> Callable[..., Any]:
        return counted if kernel is None else counted(kernel)

    numba.njit = njit
    numba.extending.intrinsic = lambda generator: _INSTRUCTIONS[generator.__name__]
    return calls
