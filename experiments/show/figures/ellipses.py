"""Error ellipses of landmarks in plan: the region that holds the true point with a given chance."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.lines import Line2D

from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float

LEVEL = 0.95
LEVEL_TEXT = f"{LEVEL:.0%}".replace("%", " %")
_PLANE_DIMENSIONS = 2


def semi_axes(covariance_m2: Float, level: float = LEVEL) -> tuple[Float, Float, Float]:
    """Ellipses of plane covariances (N, 2, 2) that hold `level` of a normal distribution.

    The squared Mahalanobis distance of a normal point is chi-square with two degrees of freedom, so
    the semi-axes are sqrt(eigenvalue * quantile), along the eigenvectors.

    Returns:
        Semi-major and semi-minor axes (N,) in metres and the major axis' direction (N,) in rad.
    """
    values, vectors = np.linalg.eigh(covariance_m2)
    lengths = np.sqrt(np.maximum(values, 0.0) * chi_square_bound(level, _PLANE_DIMENSIONS))
    direction = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    return lengths[:, 1], lengths[:, 0], direction


def ellipse_handle(colour: str) -> Line2D:
    """What stands for the ellipses in a legend, and says their level."""
    style = {"marker": "o", "markerfacecolor": "none", "markersize": 7, "linestyle": "none"}
    return Line2D([], [], color=colour, label=f"{LEVEL_TEXT} ellipses, to scale", **style)


def add_ellipses(
    axes: Axes, position_m: Float, covariance_m2: Float, level: float = LEVEL, **style: Any
) -> EllipseCollection:
    """Draw ellipses to scale, from positions (N, 2+) and covariances (N, 2+, 2+)."""
    major, minor, direction = semi_axes(covariance_m2[:, :2, :2], level)
    collection = EllipseCollection(
        2 * major,
        2 * minor,
        np.degrees(direction),
        units="xy",
        offsets=position_m[:, :2],
        offset_transform=axes.transData,
        facecolors="none",
        **style,
    )
    axes.add_collection(collection, autolim=False)
    return collection
