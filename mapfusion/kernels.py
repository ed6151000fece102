"""What Numba compiles: kernels, called from Python or by one another, and parts of kernels."""

from collections.abc import Callable
from functools import partial
from typing import Any

from numba import njit

# Compiled once for each version of its source and kept on disk. A wrapper for callers in C would
# be compiled with it; nobody here is one.
_OPTIONS: dict[str, Any] = {"cache": True, "no_cfunc_wrapper": True}
kernel: Callable[..., Any] = partial(njit, **_OPTIONS)

# For what is called by kernels alone and at one place, or is short: its lines are put into its
# caller before that is compiled, which is less to compile than both apart. Both have the same
# `error_model`: once inside, a part divides by zero as its caller does. Called from Python, as
# tests do, it is compiled by itself.
kernel_part: Callable[..., Any] = partial(kernel, inline="always")
