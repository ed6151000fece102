"""The tracks' offsets eliminated, exactly: what is left are equations of poses and landmarks.

With S the track block, P the information of the offset and G = (S + P)^-1 its covariance if path
and landmark were known, eliminating b_t leaves (a Schur complement)

    coupling (1 - G S)                  of pose and landmark
    - coupling G coupling'              between all poses that saw the track
    sum over tracks of S (1 - G S)      of the landmark

and likewise the gradients. Poses that share a track are so tied to each other more than to the
landmark. A track that does not stray has G = 0.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.se2 import Float
from mapfusion.smoother.normal_equations import NormalEquations
from mapfusion.smoother.sightings import Sightings


class Reduced(NamedTuple):
    """The equations without the offsets, but for what is between poses.

    Attributes:
        own_m2: (B, 3, 3) G of each track.
        pull: (B, 3) the gradient of each offset.
        kept: (B, 3, 3) 1 - G S, the share of a landmark's motion that its track's point takes part
            in.
        coupling: (N, 3, 3) a pose's block with a landmark, by observation.
        point_block: (L, 3, 3).
        point_gradient: (L, 3).
    """

    own_m2: Float
    pull: Float
    kept: Float
    coupling: Float
    point_block: Float
    point_gradient: Float


def without_offsets(seen: Sightings, equations: NormalEquations) -> Reduced:
    """Eliminate the offsets; the blocks between poses are left to do, with `own_m2` and `pull`."""
    S, own = equations.track_block, own_covariances(seen, equations)
    pull = equations.track_gradient + equations.offset_gradient
    kept = np.eye(3) - own @ S
    gradient = equations.track_gradient - np.einsum("tij,tj->ti", S @ own, pull)
    return Reduced(
        own,
        pull,
        kept,
        equations.coupling @ kept[seen.track],
        seen.sum_tracks(S @ kept),
        seen.sum_tracks(gradient),
    )


def own_covariances(seen: Sightings, equations: NormalEquations) -> Float:
    """(B, 3, 3) G: of offsets if path and landmarks were known; 0 of tracks that do not stray."""
    own, stray = np.zeros_like(equations.track_block), seen.strays
    information = equations.offset_information[stray, None, None] * np.eye(3)
    own[stray] = np.linalg.inv(equations.track_block[stray] + information)
    return own
