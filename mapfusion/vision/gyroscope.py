"""Turns as gyroscopes count them, joined with those of the pictures, which tell their bias.

A gyroscope counts turns where the pictures show nothing, but for a bias that hardly changes. The
filter of Mahony, Hamel, Pflimlin 2008 ("Nonlinear complementary filters on the special orthogonal
group", IEEE Transactions on Automatic Control 53) learns it from directions with a fixed gain; here
a Kalman filter does from the turns of the pictures, so that it knows how well it does.
"""

from dataclasses import dataclass, field

import numpy as np

from mapfusion import se3
from mapfusion.se2 import Float
from mapfusion.vision.rigid_links import RigidMotion

# Of a gyroscope that nobody has set to zero: 0.1 rad/s is 6 degrees a second, twice what those of a
# drone's controller begin with. Its wander over a minute is hundredths of that.
_BIAS_RAD_S = 0.1
_WANDER_RAD_S_PER_SQRT_S = 2e-4
# White noise of the rate, an angle's random walk: a phone's, and more where it shakes.
_NOISE_RAD_PER_SQRT_S = 1e-3
LOST_M = 0.1  # by how much a body may shift in a step that nothing tells of


@dataclass
class Gyroscope:
    """What is known of the bias of one gyroscope.

    Attributes:
        bias: (3,) rad/s.
        covariance: (3, 3) of its error.
    """

    bias: Float = field(default_factory=lambda: np.zeros(3))
    covariance: Float = field(default_factory=lambda: _BIAS_RAD_S**2 * np.eye(3))

    def joined(self, counted: Float, seconds: float, motion: RigidMotion | None) -> RigidMotion:
        """The motion since the frame before by pictures and gyroscope, and the bias by both.

        Args:
            counted: (3,) rotation vector since the frame before, in its axes.
            seconds: since then.
            motion: by the pictures, in the same axes; None where they tell none.
        """
        from scipy.spatial.transform import Rotation

        noise = _NOISE_RAD_PER_SQRT_S**2 * seconds * np.eye(3)
        self.covariance = self.covariance + _WANDER_RAD_S_PER_SQRT_S**2 * seconds * np.eye(3)
        own = noise + seconds**2 * self.covariance
        turn = Rotation.from_rotvec(counted - seconds * self.bias)
        if motion is None:
            covariance = np.zeros((6, 6))
            covariance[:3, :3], covariance[3:, 3:] = LOST_M**2 * np.eye(3), own
            return RigidMotion(se3.pose(turn.as_matrix(), np.zeros(3)), covariance, 0)
        T, C = motion.T_before_after, motion.covariance
        seen = Rotation.from_matrix(T[:3, :3])
        more = (turn * seen.inv()).as_rotvec()  # than the pictures have, about the axes before
        S = C[3:, 3:] + own
        gain = np.linalg.solve(S, C[3:]).T  # (6, 3)
        step = gain @ more
        R = (Rotation.from_rotvec(step[3:]) * seen).as_matrix()
        covariance = C - gain @ C[3:]
        learnt = np.linalg.solve(S, seconds * self.covariance).T
        self.bias = self.bias + learnt @ more
        self.covariance = self.covariance - seconds * learnt @ self.covariance
        joined = se3.pose(R, T[:3, 3] + step[:3])
        return RigidMotion(joined, (covariance + covariance.T) / 2, motion.n_links)
