"""What a robot's map was smoothed from: to smooth several robots' logs at once."""

from dataclasses import dataclass

import numpy as np

from mapfusion.arguments import require_shape
from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float
from mapfusion.smoother.smooth import SmootherParameters


@dataclass(frozen=True)
class Recording:
    """A robot's log, and what is known of it.

    Attributes:
        log: T frames with N observations.
        landmark: (N,) `source_observation` of the map's landmark that each observation is of;
            negative for none.
        path: (T, 3) a good guess, as of the smoother; its first pose is the map's frame.
        parameters: of the smoother.
    """

    log: RobotLog
    landmark: np.ndarray
    path: Float
    parameters: SmootherParameters

    def __post_init__(self) -> None:
        require_shape("landmark", self.landmark, (len(self.log.observations),))
        require_shape("path", self.path, (len(self.log), 3))
