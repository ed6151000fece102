"""What is left of the equations of the poses once offsets and landmarks are eliminated.

Its matrix is large and has a factor; a product with it needs neither: it goes from the poses to the
points that they saw, and back. From one step to the next the matrix changes little, so that with
the factor of a step before a few products solve for a step.
"""

from dataclasses import dataclass

import numpy as np

from mapfusion.se2 import Float
from mapfusion.smoother.conjugate_gradients import solved_by_products
from mapfusion.smoother.landmark_elimination import along_points, along_way, subtract_points
from mapfusion.smoother.normal_equations import NormalEquations
from mapfusion.smoother.offsets import Reduced, moved_points
from mapfusion.smoother.sightings import Sightings
from mapfusion.smoother.skyline import Envelope, Factor, factor_in_envelope

# What a step may be off by, as a share of it, both in sigmas: what the last ones, of hundredths of
# a sigma, leave of it is nothing, and they mend what those before left. As each leaves a third and
# more for weights that follow it, to be closer makes no step needless.
_OFF = 1e-2
# A factor of its own costs as much as this many products and more.
_MOST_PRODUCTS = 15


@dataclass(frozen=True)
class ReducedPoses:
    """The equations of T poses, of which the first is known: its rows are zero.

    Attributes:
        seen: the observations.
        equations: all of them.
        left: once the offsets are eliminated.
    """

    seen: Sightings
    equations: NormalEquations
    left: Reduced

    def gradient(self) -> Float:
        """(T, 3)."""
        still = np.zeros_like(self.equations.points.track_gradient)
        return self._with_points(self.equations.pose_gradient, self.left, still)

    def times(self, way: Float) -> Float:
        """(T, 3) the matrix times a way (T, 3) of the poses."""
        link, gained = self.equations.link, np.zeros_like(self.left.pull)
        product = np.einsum("kij,kj->ki", self.equations.pose_block, way)
        product[1:] += np.einsum("kij,kj->ki", link, way[:-1])
        product[:-1] += np.einsum("kji,kj->ki", link, way[1:])
        along = along_way(self.seen, self.equations.coupling, way)
        unpulled = np.zeros_like(self.left.point_gradient)
        still = self.left._replace(pull=gained, point_gradient=unpulled)
        return self._with_points(product, still, along)

    def factor(self) -> Factor:
        """Of the matrix without the first pose, the others in their order.

        Raises:
            LinAlgError: the matrix is not positive definite.
        """
        envelope = self.seen.order.envelope
        S = envelope.zeros()
        _put_poses(S, envelope, self.seen.pose_place[1:] - 1, self.equations)
        subtract_points(self.seen, self.equations, self.left, S)
        return factor_in_envelope(S, envelope)

    def solved(self, factor: Factor, right: Float) -> Float:
        """(T, 3) what a matrix with this factor turns into `right` (T, 3)."""
        solved = factor.solve_transposed(factor.solve(self._ordered(right)))
        return self.by_frame(solved)

    def solved_nearby(self, factor: Factor, right: Float) -> Float | None:
        """(T, 3) what the matrix turns into `right` (T, 3), by a factor that is nearly its own.

        None where that is too far off.
        """

        def roughly(rest: Float) -> Float:
            return self.by_frame(factor.solve_both_roughly(self._ordered(rest)))

        return solved_by_products(self.times, roughly, right, _OFF, _MOST_PRODUCTS)

    def _ordered(self, of_poses: Float) -> Float:
        """(3 (T - 1),) values (T, 3) of the unknown poses, in their order."""
        ordered = np.empty((len(of_poses) - 1, 3))
        ordered[self.seen.pose_place[1:] - 1] = of_poses[1:]
        return ordered.ravel()

    def by_frame(self, ordered: Float) -> Float:
        """(T, 3) the same by frame; zero for the first pose."""
        place = self.seen.pose_place
        found = np.zeros((len(place), 3))
        found[1:] = ordered.reshape(-1, 3)[place[1:] - 1]
        return found

    def _with_points(self, of_poses: Float, left: Reduced, along: Float) -> Float:
        """With what points add that follow the poses."""
        moved = moved_points(self.seen, self.equations.points, left, along)
        total = of_poses + along_points(self.seen, self.equations.coupling, *moved)
        total[0] = 0.0
        return total


def _put_poses(S: Float, envelope: Envelope, place: np.ndarray, equations: NormalEquations) -> None:
    """What odometry and the poses' own observations say, by the `place` of each unknown pose."""
    S[envelope.where(place, place)] = equations.pose_block[1:]
    after, before, link = place[1:], place[:-1], equations.link[1:]
    link = np.where((after > before)[:, None, None], link, np.swapaxes(link, 1, 2))
    S[envelope.where(np.maximum(after, before), np.minimum(after, before))] = link
