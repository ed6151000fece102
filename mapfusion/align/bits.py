"""Sets of small numbers as bits of 64-bit words."""

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

# Two instructions of every processor that Numba itself has no name for.


@intrinsic
def trailing_zeros(typing_context, word):
    """Number of the lowest bit set in a 64-bit word that is not 0."""

    def generate(context, builder, signature, args):
        return builder.cttz(args[0], context.get_constant(types.boolean, True))

    return types.int64(types.uint64), generate


@intrinsic
def ones(typing_context, word):
    """Number of bits set in a 64-bit word."""

    def generate(context, builder, signature, args):
        return builder.ctpop(args[0])

    return types.int64(types.uint64), generate


@njit(cache=True)
def count_common(first: np.ndarray, second: np.ndarray) -> int:
    """Size of the intersection of two sets (W,) uint64."""
    count = 0
    for w in range(len(first)):
        count += ones(first[w] & second[w])
    return count
