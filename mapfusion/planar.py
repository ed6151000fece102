"""Kernels of the plane that filter and alignment share: moved points, residuals, R S R^T."""

from mapfusion.kernels import inner_kernel
from mapfusion.se2 import Float


@inner_kernel
def moved_point(T_a_b: Float, cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """T p of the point (x, y); cos and sin are theta's."""
    return T_a_b[0] + cos * x - sin * y, T_a_b[1] + sin * x + cos * y


@inner_kernel
def residual(
    T_a_b: Float, cos: float, sin: float, p_a: Float, p_b: Float, i: int
) -> tuple[float, float]:
    """p_a - T p_b of pair i of points (N, 2 or more)."""
    ex = p_a[i, 0] - T_a_b[0] - cos * p_b[i, 0] + sin * p_b[i, 1]
    ey = p_a[i, 1] - T_a_b[1] - sin * p_b[i, 0] - cos * p_b[i, 1]
    return ex, ey


@inner_kernel
def lever(cos: float, sin: float, p_b: Float, i: int) -> tuple[float, float]:
    """d(T p_b) / d theta of point i of (N, 2 or more)."""
    return -sin * p_b[i, 0] - cos * p_b[i, 1], cos * p_b[i, 0] - sin * p_b[i, 1]


@inner_kernel
def add_turned(
    xx: float, xy: float, yy: float, cos: float, sin: float, bxx: float, bxy: float, byy: float
) -> tuple[float, float, float]:
    """The covariance (xx, xy, yy) plus R S R^T of another one (eq. 15)."""
    return (
        xx + cos * cos * bxx - 2 * cos * sin * bxy + sin * sin * byy,
        xy + cos * sin * (bxx - byy) + (cos * cos - sin * sin) * bxy,
        yy + sin * sin * bxx + 2 * cos * sin * bxy + cos * cos * byy,
    )
