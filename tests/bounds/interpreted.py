"""Kernels as the Python that they are written in: NumPy looks at each index before it is used."""

import functools
import sys
from collections.abc import Callable
from typing import Any

from mapfusion.geometry.numerics import Compiled

# What an instruction of the processor does, in Python.
_INSTRUCTIONS: dict[str, Callable[[Any], int]] = {
    "trailing_zeros": lambda word: (int(word) & -int(word)).bit_length() - 1,
    "popcount": lambda word: int(word).bit_count(),
}


def interpret_kernels() -> dict[str, int]:
    """Run the kernels of all imported modules as Python.

    Returns the number of calls of each kernel by its full name; it goes on counting.
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

    for module in list(sys.modules.values()):
        for name, value in vars(module).items():
            if isinstance(value, Compiled) and value.py_func.__module__ == module.__name__:
                value.compiled = _INSTRUCTIONS.get(name) or counted(value.py_func)
    return calls
