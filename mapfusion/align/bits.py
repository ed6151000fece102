"""Sets of small numbers as bits of 64-bit words."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

# Two instructions of every processor that Numba has no name for.


@intrinsic
def _trailing_zeros(typing_context: Any, word: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        del signature
        return builder.cttz(arguments[0], context.get_constant(types.boolean, True))

    del typing_context, word
    return types.int64(types.uint64), generate


@intrinsic
def _ones(typing_context: Any, word: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        del context, signature
        return builder.ctpop(arguments[0])

    del typing_context, word
    return types.int64(types.uint64), generate


# inside kernels only: number of the lowest bit set of a word that is not 0, and number of bits set
trailing_zeros = cast(Callable[[Any], int], _trailing_zeros)
ones = cast(Callable[[Any], int], _ones)


@njit(cache=True)
def count_common(first: np.ndarray, second: np.ndarray) -> int:
    """Size of the intersection of two sets (W,) uint64."""
    count = 0
    for w in range(len(first)):
        count += ones(first[w] & second[w])
    return count
