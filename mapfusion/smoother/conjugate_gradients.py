"""A linear system solved by products with its matrix (Hestenes and Stiefel 1952).

It takes the fewer of them the nearer a preconditioner is to the matrix's inverse.
"""

from collections.abc import Callable

import numpy as np

from mapfusion.se2 import Float


def solved_by_products(
    times: Callable[[Float], Float],
    preconditioned: Callable[[Float], Float],
    right: Float,
    share: float,
    most: int,
) -> Float | None:
    """The x that the positive definite matrix turns into `right`, both of any shape.

    Args:
        times: the matrix times an x.
        preconditioned: about its inverse times a right side; positive definite, too.
        right: what the product is to be.
        share: of x that it may be off by, in the norm of the matrix.
        most: products that are tried.

    Returns:
        x; None where it took more, or the matrix is not positive definite.
    """
    x, residual = np.zeros_like(right), right.copy()
    news = direction = preconditioned(residual)
    square = float(np.vdot(residual, news))
    enough = share**2 * square
    for _ in range(most):
        if square <= enough:
            return x
        product = times(direction)
        curvature = float(np.vdot(direction, product))
        if not curvature > 0:
            return None
        x += square / curvature * direction
        residual -= square / curvature * product
        news, before = preconditioned(residual), square
        square = float(np.vdot(residual, news))
        direction = news + square / before * direction
    return x if square <= enough else None
