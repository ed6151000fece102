"""IMU of a recording: direction of gravity from the accelerometer, for each frame.

An accelerometer measures gravity plus the accelerations and vibrations of the body. Gravity
dominates the mean over a long time, but not the change from frame to frame. Rotations between
frames are therefore estimated from the pictures, as a complementary filter uses gyroscopes (Mahony,
Hamel, Pflimlin 2008, "Nonlinear complementary filters on the special orthogonal group"). The filter
is `AttitudeEstimator`; this module provides its measurements and their standard deviations.
"""

import functools
import itertools
from dataclasses import dataclass

import numpy as np

from mapfusion.datasets.text_files import NS
from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float

_MAX_GAP_NS = NS // 20  # between gyroscope samples; a swaying body reverses in half a second
_MIN_GRAVITY = 5.0  # m/s²: smallest mean acceleration that defines the vertical
# Tilt error that all frames share: the bias of a consumer accelerometer changes by 0.05 m/s² from
# one start to the next.
SHARED_RAD = 0.005


@dataclass(frozen=True)
class ImuData:
    """Measurements of an accelerometer and gyroscopes in the robot's axes (x ahead, y left, z up).

    Attributes:
        time_ns: increasing times, shape (M,), int64.
        acceleration: specific force in m/s², shape (M, 3); points up at rest.
        rate: angular velocity in rad/s, shape (M, 3); None if it was not recorded.
    """

    time_ns: np.ndarray
    acceleration: Float
    rate: Float | None = None

    def __post_init__(self) -> None:
        mean = float(np.linalg.norm(self.acceleration.mean(axis=0))) if len(self.time_ns) else 0.0
        if not mean >= _MIN_GRAVITY:
            raise InputError(f"mean acceleration is {mean:.2g} m/s², too little for gravity")

    def tilts(self, time_ns: np.ndarray) -> tuple[Float, Float]:
        """Return roll and pitch at T frames, shape (T, 2), and their two standard deviations.

        The tilt of a frame is computed from the mean acceleration until halfway to the neighbouring
        frames; it is NaN if no sample lies in this interval. The standard deviations are the spread
        about the mean of all frames. They include the tilts of the body and are conservative. They
        are enlarged by the correlation of consecutive frames (`_effective_sigma`).
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
        measured = tilt[n > 0]
        if len(measured) < 2:
            raise InputError("holds no measurement while the pictures were taken")
        return tilt, np.array([_effective_sigma(values) for values in measured.T])

    def turns(self, time_ns: np.ndarray) -> Float | None:
        """Return the rotation vectors (T, 3) between frames; None without gyroscopes.

        A vector is the rotation since the frame before, in the axes of that frame.

        Vectors are NaN for the first frame and for frames with a gap in the gyroscope samples.
        Angular velocities are interpolated linearly between samples.
        """
        from scipy.spatial.transform import Rotation

        if self.rate is None:
            return None
        inside = (time_ns[0] <= self.time_ns) & (self.time_ns <= time_ns[-1])
        when = np.unique(np.concatenate([self.time_ns[inside], time_ns]))
        seconds = np.diff(when) / NS
        middle = (when[1:] + when[:-1]) / 2 - when[0]
        rates = [np.interp(middle, self.time_ns - when[0], axis) for axis in self.rate.T]
        step_rotations = Rotation.from_rotvec(np.stack(rates, -1) * seconds[:, None]).as_matrix()
        index = np.searchsorted(when, time_ns)
        # Samples around each interval, which must enclose it without a gap.
        index_before = np.searchsorted(self.time_ns, time_ns[:-1], side="right") - 1
        index_after = np.searchsorted(self.time_ns, time_ns[1:])
        turns = np.full((len(time_ns), 3), np.nan)
        for k, (first, stop) in enumerate(itertools.pairwise(index), start=1):
            i, j = int(index_before[k - 1]), int(index_after[k - 1])
            if i < 0 or j == len(self.time_ns):
                continue
            if int(np.diff(self.time_ns[i : j + 1]).max()) <= _MAX_GAP_NS:
                R = functools.reduce(np.matmul, step_rotations[first:stop])
                turns[k] = Rotation.from_matrix(R).as_rotvec()
        return turns


def _effective_sigma(values: Float) -> float:
    """Return the standard deviation of values (N,), enlarged for their autocorrelation.

    The mean of N independent values with this deviation has the same error as the mean of the
    correlated ones. Autocorrelations are summed until they become negative (Geyer 1992, "Practical
    Markov chain Monte Carlo").
    """
    deviation = values - values.mean()
    square = float(deviation @ deviation)
    if square == 0:
        return 0.0
    correlation_time = 1.0
    for lag in range(1, len(deviation)):
        correlation = float(deviation[lag:] @ deviation[:-lag]) / square
        if correlation <= 0:
            break
        correlation_time += 2 * correlation
    return float(np.sqrt(square / len(deviation) * correlation_time))
