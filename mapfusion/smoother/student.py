"""Student-t distributed observations: their weights, and how heavy their tails are.

A share of the observations is of corners that are none, or of other landmarks. A Student-t gives
them less weight the farther off they are, and its degrees of freedom, found from the residuals
themselves, say how many there are: of Gaussian residuals they grow without limit and all weights
are one. Lange, Little, Taylor (1989), "Robust statistical modeling using the t distribution".
"""

import numpy as np
from scipy.optimize import fminbound
from scipy.special import gammaln

from mapfusion.se2 import Float

# Tails heavier than the first give (a Cauchy's are at 1) are no sensor's; above the second nobody
# can tell it from a Gaussian.
LEAST_DOF, MOST_DOF = 0.5, 1e4


def student_weights(squares: Float, dof: float, n_dimensions: int) -> Float:
    """Weights (N,) of observations at these squared Mahalanobis distances (N,)."""
    return (dof + n_dimensions) / (dof + squares)


def student_cost(squares: Float, dof: float, n_dimensions: int) -> float:
    """Twice the negative log likelihood, up to what does not depend on the distances."""
    return float((dof + n_dimensions) * np.sum(np.log1p(squares / dof)))


def fitted_dof(squares: Float, n_dimensions: int) -> float:
    """The degrees of freedom under which these squared distances (N,) are most likely."""

    def cost(log_dof: float) -> float:
        dof = float(np.exp(log_dof))
        normal = gammaln((dof + n_dimensions) / 2) - gammaln(dof / 2) - n_dimensions / 2 * log_dof
        return student_cost(squares, dof, n_dimensions) - 2 * len(squares) * float(normal)

    return float(np.exp(fminbound(cost, np.log(LEAST_DOF), np.log(MOST_DOF))))
