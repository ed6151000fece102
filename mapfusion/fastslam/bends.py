"""How far a path may still bend, and how it bends when a loop closes.

Particles that were resampled share their past, and no weight mends what it errs by. That is a walk:
while the robot goes on, the map to come slowly turns and shifts against the one there is. A bend is
such a motion of the plane, (x, y, angle) about the map's origin, where small ones add. At each knot
of the path it is unknown, and when landmarks from before are seen again, the difference of two of
them is observed. What the path then does between is the mean of a Gaussian given that observation:
a proposal for a block of past states that knows the observation at its end (Doucet, Briers, Senecal
2006), for a chain of poses in closed form (Dubbelman, Browning 2015), here with any number of
loops, one inside the other.
"""

import numpy as np

from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float

# Frames between two knots at first. A landmark that has been out of view for less has lost its
# track, and what the path did meanwhile is in the landmarks that stayed.
SPACING = 20
# Knots that are kept; with more, every second one goes. A drive seldom closes more loops at once
# than these tell apart, and closing one takes the square of their number.
_MOST_KNOTS = 64
# Directions of a group of sightings that say less than this share of what the best one says, say
# nothing: one point does not tell how the plane turns about it.
_SAYS_NOTHING = 1e-9
# Bends are put off until one moves the robot by this much: moving a map costs as much as a frame.
_WORTH_M = 1e-3


class Bends:
    """The bends at K knots and now, jointly Gaussian; each mean is zero once the path has bent."""

    def __init__(self) -> None:
        self.frame = -1  # the last that went by
        self._knots = np.zeros(1, dtype=np.int64)  # their frames, ascending
        self._spacing = SPACING
        self._covariance = np.zeros((6, 6))  # of the first knot and of now, which are the map's
        self._due = np.zeros(6)  # what the path has yet to be bent by

    def went_on(self, covariance: Float) -> None:
        """The next frame; `covariance` (3, 3) of what the path may have bent by since the last."""
        if self.frame - self._knots[-1] >= self._spacing:
            self._add_knot()
        self.frame += 1
        self._covariance[-3:, -3:] += covariance

    def closed(
        self, frame: np.ndarray, information: Float, pull: Float, now: Float, probability: float
    ) -> None:
        """Landmarks from before are seen again: where does this bend the path?

        Args:
            frame: (G,) that showed each group of them last.
            information: (G, 3, 3) of each about the motion that would put the robot right.
            pull: (G, 3) gradient of its log likelihood: information times that motion.
            now: (3, 3) covariance of the pose, as a motion, given what has stayed in view.
            probability: share of true closures that are believed (chi-square quantile).
        """
        value, vector = np.linalg.eigh(information)
        group, told = np.nonzero(value > _SAYS_NOTHING * value[:, -1:])
        root = np.sqrt(value[group, told])
        direction = vector[group, :, told]  # (n, 3)
        seen = np.sum(direction * pull[group], axis=1) / root  # of unit variance
        rows = root[:, None] * direction
        knot, share = self._between(frame[group])
        n, each = len(self._knots) + 1, np.arange(len(rows))
        slope = np.zeros((len(rows), n, 3))
        slope[:, -1] = rows
        slope[each, knot] -= (1 - share)[:, None] * rows
        slope[each, knot + 1] -= share[:, None] * rows
        slope = slope.reshape(len(rows), 3 * n)
        spread = self._covariance @ slope.T
        noise = np.eye(len(rows)) + rows @ now @ rows.T
        news = seen - slope @ self._due
        solved = np.linalg.solve(slope @ spread + noise, np.column_stack([news, spread.T]))
        if news @ solved[:, 0] > chi_square_bound(probability, len(news)):
            return
        covariance = self._covariance - spread @ solved[:, 1:]
        self._covariance = 0.5 * (covariance + covariance.T)
        self._due = self._due + spread @ solved[:, 0]

    def due(self, place: Float) -> Float | None:
        """Bends (K + 1, 3) of knots and now that the path has yet to take, and takes with this.

        None as long as none of them would move a point at `place` (2,) by a millimetre.
        """
        bends = self._due.reshape(-1, 3)
        shift = bends[:, :2] + bends[:, 2:] * [-place[1], place[0]]
        if np.max(np.sum(shift**2, axis=1)) < _WORTH_M**2:
            return None
        self._due = np.zeros_like(self._due)
        return bends

    def at(self, bends: Float, frame: np.ndarray) -> Float:
        """Bends (n, 3) at frames (n,), given those of knots and now."""
        knot, share = self._between(frame)
        return bends[knot] + share[:, None] * (bends[knot + 1] - bends[knot])

    def _between(self, frame: np.ndarray) -> tuple[np.ndarray, Float]:
        """(n,) knot before each frame, and how far on the way to the next one, or to now, it is."""
        when = np.append(self._knots, self.frame)
        knot = np.clip(np.searchsorted(when, frame, side="right") - 1, 0, len(when) - 2)
        return knot, (frame - when[knot]) / (when[knot + 1] - when[knot])

    def _add_knot(self) -> None:
        self._knots = np.append(self._knots, self.frame)
        kept = np.arange(len(self._knots) + 1)
        if len(self._knots) > _MOST_KNOTS:
            self._spacing *= 2
            kept = np.append(kept[:-1:2], kept[-1])
        # what is now stands for the new knot and goes on
        state = (3 * np.minimum(kept, len(self._knots) - 1)[:, None] + np.arange(3)).ravel()
        self._covariance = self._covariance[np.ix_(state, state)]
        self._due = self._due[state]
        self._knots = self._knots[kept[:-1]]
