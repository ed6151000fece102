"""Numerical building blocks: kernels, 3 x 3 matrices, bit sets, rows, generators, checks.

BLAS threads: NumPy and SciPy each have a BLAS with its own threads, and the threads of one BLAS
spin while the other computes. Alternating calls with small blocks, as in an envelope factorisation,
are several times slower than with one thread (`one_blas_thread`).

Products of 3 x 3 matrices are written out by entries: a BLAS call takes longer than the product,
and its rounding depends on the processor.
"""

import math
import zlib
from collections.abc import Callable
from dataclasses import fields
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Float = NDArray[np.float64]
Arrays = TypeVar("Arrays", bound="DataclassInstance")


class Compiled:
    """Function that Numba compiles at its first call, or at that of a kernel which calls it.

    The import of Numba takes longer than a command that needs no kernel.

    Attributes:
        py_func: the Python function.
    """

    def __init__(self, function: Callable[..., Any], compiler: Callable[..., Any]) -> None:
        self.py_func, self._compiler = function, compiler

    @cached_property
    def compiled(self) -> Any:
        """Numba's function for calls from Python, kept on disk."""
        _prepare_numba()
        return self._compiler(self.py_func, cache=True)

    @cached_property
    def inner(self) -> Any:
        """Numba's function for calls from kernels, which are kept on disk together with it.

        It does not convert arguments of Python, which saves a third of its compilation.
        """
        return self._compiler(self.py_func, no_cpython_wrapper=True)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function from Python."""
        return self.compiled(*arguments)


_before_compilation: list[Callable[[], None]] = []  # at most one


def before_compilation(action: Callable[[], None] | None) -> None:
    """Set a function that is called once, before this process compiles its first kernel.

    Kernels that are loaded from the disk do not count. None removes the function of an earlier
    call.
    """
    _before_compilation[:] = [] if action is None else [action]


@cache
def _prepare_numba() -> None:
    """Give a `Compiled` object the Numba type of its `inner` function; observe compilations."""
    from numba.core.event import Listener, register
    from numba.core.registry import cpu_target
    from numba.extending import typeof_impl

    context = cast(Any, cpu_target).typing_context
    typeof_impl.register(Compiled)(lambda own, _: context.resolve_value_type(own.inner))

    class Observer(Listener):
        def on_start(self, event: Any) -> None:
            while _before_compilation:
                _before_compilation.pop()()

        def on_end(self, event: Any) -> None:
            pass

    register("numba:compile", Observer())


def kernel(function: Any = None, **options: Any) -> Any:
    """Compile a function with Numba, once for each version of its source.

    Nothing calls kernels from C, so they have no wrapper for that.
    """

    def compiler(python: Any, **further: Any) -> Any:
        from numba import njit

        return cast(Any, njit)(python, no_cfunc_wrapper=True, **options, **further)

    return partial(kernel, **options) if function is None else Compiled(function, compiler)


def source_of(compiled: Callable[..., Any]) -> Callable[..., Any]:
    """Return the Python function of a kernel, for use with whole NumPy arrays."""
    return getattr(compiled, "py_func", compiled)


one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorator that limits BLAS to one thread while the function runs."""


@cache  # a filter computes its gate in every step
def chi_square_bound(probability: float, degrees_of_freedom: float) -> float:
    """Return the quantile of the chi-square distribution at a probability.

    The distribution function is P(k / 2, x / 2), the regularised incomplete gamma function. Its
    inverse avoids the slow import of scipy.stats in every worker.
    """
    # A local import: many processes need no gate.
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(degrees_of_freedom / 2, probability))


def squared_mahalanobis(error: Float, covariance: Float) -> Float:
    """Return squared Mahalanobis lengths of errors (..., D) with covariances (..., D, D)."""
    return np.vecdot(error, np.linalg.solve(covariance, error[..., None])[..., 0])


_SINGULAR = 1e-12  # largest determinant by rounding errors, for a matrix of unit diagonal


@kernel
def cofactors(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float, float]:
    """Return the cofactors (six upper entries) and the determinant of a symmetric 3x3 matrix."""
    axx, axy, axz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    ayy, ayz, azz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    return axx, axy, axz, ayy, ayz, azz, xx * axx + xy * axy + xz * axz


@kernel
def invert(matrix: Float, inverse: Float) -> bool:
    """Fill the inverse (3, 3) of a symmetric matrix; False unless positive definite."""
    a, d, f = matrix[0, 0], matrix[1, 1], matrix[2, 2]
    axx, axy, axz, ayy, ayz, azz, det = cofactors(a, matrix[0, 1], matrix[0, 2], d, matrix[1, 2], f)
    positive = a > 0 and azz > 0  # with det > 0 the leading minors (Sylvester)
    if not (positive and det > _SINGULAR * a * d * f):
        return False
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = axx / det, ayy / det, azz / det
    inverse[0, 1] = inverse[1, 0] = axy / det
    inverse[0, 2] = inverse[2, 0] = axz / det
    inverse[1, 2] = inverse[2, 1] = ayz / det
    return True


@kernel
def copy_lower(matrix: Float, copy: Float) -> None:
    """Copy the lower half of a matrix.

    Numba's `copy[:] = matrix` takes seconds to compile, for its messages about unequal shapes.
    """
    for i in range(len(matrix)):
        for j in range(i + 1):
            copy[i, j] = matrix[i, j]


@kernel
def cholesky(matrix: Float, singular: float) -> bool:
    """Compute the lower Cholesky factor of a symmetric matrix in place, from its lower half.

    Returns:
        False if the matrix is not positive definite: a pivot is at most `singular` times its
        diagonal entry.
    """
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = rest / matrix[j, j]
            elif rest > singular * matrix[i, i]:
                matrix[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@kernel
def solve_lower(factor: Float, x: Float) -> None:
    """Solve factor y = x in place."""
    for i in range(len(x)):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]


@kernel
def solve_upper(factor: Float, x: Float) -> None:
    """Solve factor^T y = x in place."""
    for i in range(len(x) - 1, -1, -1):
        for k in range(i + 1, len(x)):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]


def times_vectors(A: Float, x: Float) -> Float:
    """Return the products (N, 3) of blocks (N, 3, 3) and vectors (N, 3)."""
    return A[:, :, 0] * x[:, None, 0] + A[:, :, 1] * x[:, None, 1] + A[:, :, 2] * x[:, None, 2]


@kernel
def times_blocks(A: Float, B: Float) -> Float:
    """Return the products (N, 3, 3) of blocks (N, 3, 3)."""
    product = np.empty(A.shape)
    for i in range(len(product)):
        for r in range(3):
            x, y, z = A[i, r, 0], A[i, r, 1], A[i, r, 2]
            for q in range(3):
                product[i, r, q] = x * B[i, 0, q] + y * B[i, 1, q] + z * B[i, 2, q]
    return product


def sums_by(group: np.ndarray, values: Float, n: int) -> Float:
    """Return the sums (n, ...) of values (N, ...) per group.

    Args:
        group: group of each value, 0 to n - 1, shape (N,).
        values: shape (N, ...).
        n: number of groups.
    """
    total = np.empty((n, *values.shape[1:]))
    for column in np.ndindex(*values.shape[1:]):
        total[:, *column] = np.bincount(group, values[:, *column], n)
    return total


def inverses(blocks: Float) -> Float:
    """Return the inverses (N, D, D) of symmetric blocks (N, D, D) = L D L', D two or three.

    The lower half of each block is read.

    Raises:
        LinAlgError: a block is not positive definite.
    """
    n, dimensions = blocks.shape[:2]
    entries = np.zeros((6, n))  # lower halves; 2 x 2 blocks get a third row of the identity
    entries[5] = 1.0
    pairs = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
    for k, (r, q) in enumerate(pairs):
        if r < dimensions:
            entries[k] = blocks[:, r, q]
    a00, a10, a11, a20, a21, a22 = entries
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        l10, l20 = a10 / a00, a20 / a00
        d1 = a11 - l10 * a10
        rest = a21 - l20 * a10
        l21 = rest / d1
        d2 = a22 - l20 * a20 - l21 * rest
        m20 = l10 * l21 - l20  # entry of L^-1; the other entries are -l10 and -l21
        inverse = (
            1 / a00 + l10 * l10 / d1 + m20 * m20 / d2,
            -l10 / d1 - m20 * l21 / d2,
            1 / d1 + l21 * l21 / d2,
            m20 / d2,
            -l21 / d2,
            1 / d2,
        )
        positive = (a00 > 0) & (d1 > 0) & (d2 > 0)
    if not positive.all():
        raise np.linalg.LinAlgError("a block is not positive definite")
    inverse_blocks = np.empty(blocks.shape)
    for (r, q), entry in zip(pairs, inverse, strict=True):
        if r < dimensions:
            inverse_blocks[:, r, q] = inverse_blocks[:, q, r] = entry
    return inverse_blocks


WORD = 64

# Factor that packs eight bytes of 0 or 1: bit 56 + k of the product is byte k (a sum of shifts by 7
# to 56).
_GATHER = np.uint64(0x0102040810204080)


def _instruction(generator: Callable[[Any, Any], Any]) -> Compiled:
    """Make a processor instruction without a Numba function, for use inside kernels only."""

    def compiler(python: Any, **_: Any) -> Any:
        from numba.core.registry import cpu_target
        from numba.extending import intrinsic

        made = intrinsic(python)
        cast(Any, cpu_target).typing_context.refresh()  # it is known from here on
        return made

    return Compiled(generator, compiler)


@_instruction
def trailing_zeros(typing_context: Any, word: Any) -> Any:
    """Return the number of the lowest bit set in a word that is not 0."""
    from numba import types

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        del signature
        return builder.cttz(arguments[0], context.get_constant(types.boolean, True))

    del typing_context, word
    return types.int64(types.uint64), generate


@_instruction
def popcount(typing_context: Any, word: Any) -> Any:
    """Return the number of bits set in a word."""
    from numba import types

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        del context, signature
        return builder.ctpop(arguments[0])

    del typing_context, word
    return types.int64(types.uint64), generate


@kernel
def count_common(first: np.ndarray, second: np.ndarray) -> int:
    """Return the size of the intersection of two bit sets (W,) uint64."""
    count = 0
    for w in range(len(first)):
        count += popcount(first[w] & second[w])
    return count


@kernel
def packed(eights: np.ndarray, w: int) -> np.uint64:
    """Pack word w of a bit set.

    Args:
        eights: members as bytes of 0 or 1, eight bytes per number.
        w: index of the word.
    """
    word = np.uint64(0)
    for k in range(8):
        word |= ((eights[8 * w + k] * _GATHER) >> np.uint64(56)) << np.uint64(8 * k)
    return word


@kernel
def transpose(square: np.ndarray) -> None:
    """Transpose a matrix of 64 x 64 bits by recursive exchange of blocks (Warren 2012, 7-3)."""
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
    """Make an adjacency matrix (N, W) symmetric that has only the edges to later vertices."""
    n, words = graph.shape
    square = np.empty(WORD, np.uint64)
    for r in range(words):
        for c in range(r, words):
            for k in range(WORD):
                square[k] = graph[r * WORD + k, c] if r * WORD + k < n else np.uint64(0)
            transpose(square)
            for k in range(min(WORD, n - c * WORD)):
                graph[c * WORD + k, r] |= square[k]


# Above these limits, rounding errors of squared distances and determinants are too large.
LARGEST_POSITION_M = 1e7
LARGEST_SIGMA_M = 1e5


def require_finite(name: str, values: np.ndarray) -> None:
    """Raise ValueError when `values` holds NaN or infinity."""
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: contains NaN or infinity")


def with_rows(value: Arrays, rows: slice | np.ndarray) -> Arrays:
    """Return a copy of a dataclass with some rows of each array.

    The checks of the constructor are skipped, since slicing logs into frames must be fast.
    """
    cut = object.__new__(type(value))
    for field in fields(value):
        v = getattr(value, field.name)
        vars(cut)[field.name] = v[rows] if isinstance(v, np.ndarray) else v
    return cut


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


def generator(seed: int, *purpose: str | int) -> np.random.Generator:
    """Return the generator for a purpose, for example ("odometry", "R1").

    Its numbers do not depend on other generators.
    """
    key = tuple(zlib.crc32(str(part).encode()) for part in purpose)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
