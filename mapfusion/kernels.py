"""What Numba compiles: kernels, called from Python or by one another; inner ones; and parts."""

from collections.abc import Callable
from functools import partial
from typing import Any

from numba import njit
from numba.core.registry import CPUDispatcher

# Compiled once for each version of its source and kept on disk. A wrapper for callers in C would
# be compiled with it; nobody here is one.
_OPTIONS: dict[str, Any] = {"cache": True, "no_cfunc_wrapper": True}
kernel: Callable[..., Any] = partial(njit, **_OPTIONS)


class _Inner(CPUDispatcher):
    """Has no wrapper for callers in Python, without which a call ends the process."""

    def __call__(self, *arguments: object) -> Any:
        raise TypeError(f"{self.py_func.__name__}: only kernels can call it")


def inner_kernel(function: Any = None, **options: Any) -> Any:
    """For what is called by kernels alone, at several places.

    The wrapper for callers in Python, which is up to half of what is compiled for a short one, is
    left out; tests take what `tests.helpers.inner_kernels` makes of it. Such a kernel makes no
    arrays: what Numba compiles for that, it would compile once more for these.
    """
    if function is None:
        return partial(inner_kernel, **options)
    made = kernel(function, no_cpython_wrapper=True, **options)
    if isinstance(made, CPUDispatcher):  # not so with NUMBA_DISABLE_JIT
        made.__class__ = _Inner
    return made


def source_of(compiled: Callable[..., Any]) -> Callable[..., Any]:
    """The function that a kernel was made of, which NumPy's arrays may be given to as well."""
    return getattr(compiled, "py_func", compiled)


# For what is called by kernels alone and at one place, or is short: its lines are put into its
# caller before that is compiled, which is less to compile than both apart. Both have the same
# `error_model`: once inside, a part divides by zero as its caller does. Called from Python, as
# tests do, it is compiled by itself.
kernel_part: Callable[..., Any] = partial(kernel, inline="always")
