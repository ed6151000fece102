"""Sets of small numbers as bits of 64-bit words."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numba import types
from numba.extending import intrinsic

from mapfusion.kernels import inner_kernel, kernel, kernel_part

WORD = 64

# Times eight bytes of 0 or 1: bit 56 + k of the product is byte k (a sum of shifts by 7 to 56).
_GATHER = np.uint64(0x0102040810204080)

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


@inner_kernel
def count_common(first: np.ndarray, second: np.ndarray) -> int:
    """Size of the intersection of two sets (W,) uint64."""
    count = 0
    for w in range(len(first)):
        count += ones(first[w] & second[w])
    return count


@inner_kernel
def packed(eights: np.ndarray, w: int) -> np.uint64:
    """Word w of a set whose members are bytes of 1, the others 0; `eights` are eight bytes each."""
    word = np.uint64(0)
    for k in range(8):
        word |= ((eights[8 * w + k] * _GATHER) >> np.uint64(56)) << np.uint64(8 * k)
    return word


@kernel_part
def transpose(square: np.ndarray) -> None:
    """Exchange rows and columns of 64 words: halves of halves change places (Warren 2012, 7-3)."""
    size, low = WORD // 2, np.uint64(0xFFFFFFFF)
    while size:
        shift = np.uint64(size)
        for first in range(0, WORD, 2 * size):
            for k in range(first, first + size):
                differs = ((square[k] >> shift) ^ square[k + size]) & low
                square[k] ^= differs << shift
                square[k + size] ^= differs
        size //= 2
        low ^= low << np.uint64(size)


@kernel
def mirror(graph: np.ndarray) -> None:
    """Make a graph (N, W) symmetric of which only the edges to later vertices are there."""
    n, words = graph.shape
    square = np.empty(WORD, np.uint64)
    for r in range(words):
        for c in range(r, words):
            for k in range(WORD):
                square[k] = graph[r * WORD + k, c] if r * WORD + k < n else np.uint64(0)
            transpose(square)
            for k in range(min(WORD, n - c * WORD)):
                graph[c * WORD + k, r] |= square[k]
