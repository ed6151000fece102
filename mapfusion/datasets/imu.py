"""IMU of a recording: direction of gravity from the accelerometer, for each frame.

An accelerometer feels gravity and how the body speeds up, sways and shakes. Gravity alone stays, so
its direction is right in the long run and turns from frame to frame are not: those come from the
pictures, as a complementary filter takes them from gyroscopes (Mahony, Hamel, Pflimlin 2008,
"Nonlinear complementary filters on the special orthogonal group"). The filter is `Levelling`'s;
here is what it takes for measured, and how far that strays.
"""

import functools
import itertools
from dataclasses import dataclass

import numpy as np

from mapfusion.datasets.text_files import NS
from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float

_LONGEST_SILENCE_NS = NS // 20  # of gyroscopes; a body that sways turns about in half a second
LEAST_GRAVITY = 5.0  # m/s²: of a mean acceleration that is to say where up is
# Of all frames alike: an accelerometer of a phone's or drone's kind is 0.05 m/s² off from one start
# to the next.
SHARED_RAD = 0.005


@dataclass(frozen=True)
class ImuData:
    """What an accelerometer and gyroscopes felt, in the robot's axes.

    Attributes:
        time_ns: (M,) int64, increasing.
        acceleration: (M, 3) in m/s², upwards at rest; x ahead, y left, z up of the robot.
        rate: (M, 3) angular velocity in rad/s; None: it was not recorded.
    """

    time_ns: np.ndarray
    acceleration: Float
    rate: Float | None = None

    def __post_init__(self) -> None:
        mean = float(np.linalg.norm(self.acceleration.mean(axis=0))) if len(self.time_ns) else 0.0
        if not mean >= LEAST_GRAVITY:
            raise InputError(f"mean acceleration is {mean:.2g} m/s², too little for gravity")

    def tilts(self, time_ns: np.ndarray) -> tuple[Float, Float]:
        """Roll and pitch at T frames, (T, 2), and (2,) their standard deviations.

        A frame has the mean over the time until halfway to its neighbours; NaN where nothing was
        felt then. Deviations are the spread about the mean of all, the body's own tilts included,
        so rather too large, as much larger as neighbours repeat each other: by the sum of their
        correlations, until it turns negative (Geyer 1992, "Practical Markov chain Monte Carlo").
        """
        middle = (time_ns[1:] + time_ns[:-1]) // 2
        edges = np.concatenate(
            [[2 * time_ns[0] - middle[0]], middle, [2 * time_ns[-1] - middle[-1]]]
        )
        bounds = np.searchsorted(self.time_ns, edges)
        summed = np.vstack([np.zeros(3), np.cumsum(self.acceleration, axis=0)])
        n = np.diff(bounds)
        up = np.full((len(time_ns), 3), np.nan)
        up[n > 0] = (np.diff(summed[bounds], axis=0)[n > 0].T / n[n > 0]).T
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        tilt = np.column_stack([np.arctan2(up[:, 1], up[:, 2]), -np.arcsin(up[:, 0])])
        felt = tilt[n > 0]
        if len(felt) < 2:
            raise InputError("felt nothing while the pictures were taken")
        return tilt, np.array([_as_if_independent(values) for values in felt.T])

    def turns(self, time_ns: np.ndarray) -> Float | None:
        """Turns (T, 3) at T frames since the one before, in its axes; None without gyroscopes.

        Rotation vectors; NaN for the first frame and where the gyroscopes were silent. Rates
        between two samples lie between theirs.
        """
        from scipy.spatial.transform import Rotation

        if self.rate is None:
            return None
        inside = (time_ns[0] <= self.time_ns) & (self.time_ns <= time_ns[-1])
        when = np.unique(np.concatenate([self.time_ns[inside], time_ns]))
        seconds = np.diff(when) / NS
        middle = (when[1:] + when[:-1]) / 2 - when[0]
        rates = [np.interp(middle, self.time_ns - when[0], axis) for axis in self.rate.T]
        small = Rotation.from_rotvec(np.stack(rates, -1) * seconds[:, None]).as_matrix()
        place = np.searchsorted(when, time_ns)
        turns = np.full((len(time_ns), 3), np.nan)
        for k, (first, stop) in enumerate(itertools.pairwise(place), start=1):
            if self._felt_between(time_ns[k - 1], time_ns[k]):
                R = functools.reduce(np.matmul, small[first:stop])
                turns[k] = Rotation.from_matrix(R).as_rotvec()
        return turns

    def _felt_between(self, first_ns: int, last_ns: int) -> bool:
        """Whether samples span the time, and none is far from the next."""
        first = int(np.searchsorted(self.time_ns, first_ns, side="right")) - 1
        last = int(np.searchsorted(self.time_ns, last_ns))
        if first < 0 or last == len(self.time_ns):
            return False
        return int(np.diff(self.time_ns[first : last + 1]).max()) <= _LONGEST_SILENCE_NS


def _as_if_independent(values: Float) -> float:
    """Standard deviation of values (N,) that would average out no faster than these do."""
    off = values - values.mean()
    square = float(off @ off)
    if square == 0:
        return 0.0
    together = 1.0
    for lag in range(1, len(off)):
        correlation = float(off[lag:] @ off[:-lag]) / square
        if correlation <= 0:
            break
        together += 2 * correlation
    return float(np.sqrt(square / len(off) * together))
