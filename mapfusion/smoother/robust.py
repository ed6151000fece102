"""Robust losses: both the observations' own errors and the tracks' offsets are Student-t.

A gross observation loses its weight and its track keeps the rest. A track that as a whole is of
another landmark has an offset far beyond all others: it no longer pulls at the landmark, and still
holds the poses that saw it together, as it is one point all the same.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.smoother.normal_equations import Estimate, Shares, Weights
from mapfusion.smoother.offsets import Points
from mapfusion.smoother.residuals import (
    known_dimensions,
    offset_squares,
    squared_distances,
    squares_of_points,
)
from mapfusion.smoother.sightings import Sightings
from mapfusion.smoother.student import (
    MOST_DOF,
    fitted_dof,
    information_share,
    student_weights,
)


class Tails(NamedTuple):
    """Degrees of freedom of the Student-t's of observations and offsets."""

    observation: float
    offset: float


NO_TAILS = Tails(MOST_DOF, MOST_DOF)


def informative(tails: Tails, n_dimensions: int) -> Shares:
    """What of the weighted information is there in truth."""
    return Shares(*(float(information_share(dof, n_dimensions)) for dof in tails))


def unweighted(seen: Sightings) -> Weights:
    """All ones; tracks that do not stray have no offsets that anything could be known about."""
    return Weights(np.ones(len(seen)), seen.strays.astype(np.float64))


def reweighted(
    seen: Sightings,
    at: Estimate,
    weights: Weights,
    tails: Tails,
    known: Points,
    stray_information: float,
) -> tuple[Weights, Tails]:
    """New weights and tails, given those so far and what is known of points under them.

    Of observations the squares are those expected about the true points (the E step of Lange et
    al.). Offsets have a Student-t in as many dimensions as they are known in, else those of
    landmarks with a single track, which look perfectly average, would hide the tails of the rest.
    """
    n, new = seen.n_dimensions, unweighted(seen)
    squares = squared_distances(seen, at)
    squares += squares_of_points(seen, at.path, known.track_m2)
    of_offset = offset_squares(seen, at, stray_information)
    dimensions = known_dimensions(seen, known.offset_m2, weights.offset * stray_information)
    tails = Tails(
        fitted_dof(squares, n, tails.observation),
        fitted_dof(of_offset, dimensions, tails.offset),
    )
    new.observation[:] = student_weights(squares, tails.observation, n)
    new.offset[seen.strays] = student_weights(of_offset, tails.offset, dimensions)
    return new, tails
