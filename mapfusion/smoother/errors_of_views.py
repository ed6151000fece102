"""What views of landmarks add to the equations: with errors of their own, or shared along tracks.

Either kind is robust: a share of the views is of corners that are none or of other landmarks, and a
share of the tracks strays far more than the rest. Both are Student-t, weighted anew at each step.
"""

import numpy as np

from mapfusion.se2 import Float
from mapfusion.smoother.normal_equations import Estimate, NormalEquations, add_observations
from mapfusion.smoother.residuals import squared_distances
from mapfusion.smoother.sightings import Sightings
from mapfusion.smoother.student import MOST_DOF, fitted_dof, student_cost, student_weights
from mapfusion.smoother.tracks import Stray, add_tracks, track_distances, track_information


class OwnErrors:
    """Each view errs on its own.

    Attributes:
        weight: (N,) of the views.
        dof: degrees of freedom of their Student-t.
    """

    def __init__(self, seen: Sightings) -> None:
        self._seen = seen
        self.weight, self.dof = np.ones(len(seen)), MOST_DOF

    def add(self, at: Estimate, made: NormalEquations) -> NormalEquations:
        """The equations with all views."""
        add_observations(self._seen, at, self.weight, made)
        return made

    def cost(self, at: Estimate) -> float:
        """Twice the negative log likelihood, but for a constant."""
        return student_cost(squared_distances(self._seen, at), self.dof, self._seen.n_dimensions)

    def weigh(self, at: Estimate, own_m2: Float) -> None:
        """Weights anew, given what is uncertain about each landmark (L, 3, 3) beside the path."""
        squares, n = squared_distances(self._seen, at, own_m2), self._seen.n_dimensions
        self.dof = fitted_dof(squares, n)
        self.weight = student_weights(squares, self.dof, n)


class SharedErrors:
    """Each view errs on its own, and all of a track as its corner strays.

    Attributes:
        weight: (N,) of the views.
        dof: degrees of freedom of the views' Student-t.
        track_weight: (L,) of the tracks.
        track_dof: degrees of freedom of the tracks' Student-t.
    """

    def __init__(self, seen: Sightings, stray: Stray, at: Estimate) -> None:
        self._seen, self._stray = seen, stray
        self.weight, self.dof = np.ones(len(seen)), MOST_DOF
        self.track_weight, self.track_dof = np.ones(len(seen.starts) - 1), MOST_DOF
        self._inform(at)

    def _inform(self, at: Estimate) -> None:
        heading_rad = np.ascontiguousarray(at.path[:, 2])
        self._tracks = track_information(
            self._seen, heading_rad, self._stray, self.weight, self.track_weight
        )

    def add(self, at: Estimate, made: NormalEquations) -> NormalEquations:
        """The equations with all views."""
        n = 3 * len(at.path)
        made = made._replace(between=np.zeros((n, n)))
        assert made.between is not None
        add_tracks(self._seen, at, self._tracks, made, made.between)
        return made

    def cost(self, at: Estimate) -> float:
        """Twice the negative log likelihood with the weights as they are, but for a constant."""
        return float(track_distances(self._seen, at, self._tracks, self.weight)[0].sum())

    def weigh(self, at: Estimate, own_m2: Float) -> None:
        """Weights anew; `own_m2` is part of the views' distances from the others already."""
        n = self._seen.n_dimensions
        of_track, of_view = track_distances(self._seen, at, self._tracks, self.weight)
        # without the weights that went into them
        of_track /= self.track_weight
        of_view /= self.track_weight[self._seen.landmark]
        left = n * (np.diff(self._seen.starts) - 1)  # of a track, when its landmark is fitted
        self.track_dof = fitted_dof(of_track, left)
        self.track_weight = student_weights(of_track, self.track_dof, left)
        self.dof = fitted_dof(of_view, n)
        self.weight = student_weights(of_view, self.dof, n)
        self._inform(at)
