"""How a robot's body pitches and rolls as it drives, and how well it knows that."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.geometry.numerics import Float
from mapfusion.parameters import Range, require_in_range

_THREE_TENTHS_RAD = 0.0052  # of a degree: a small IMU's inclinometer on a robot that moves


@dataclass(frozen=True)
class BodySway:
    """Roll and pitch of a body on its suspension, about its origin on the floor; 0: it is rigid.

    Attributes:
        sigma_rad: standard deviation of each.
        correlation_s: time after which e-th part of it is left (a process of Ornstein-Uhlenbeck).
    """

    sigma_rad: Annotated[float, Range(0, 0.15, "rad")] = 0.0
    correlation_s: Annotated[float, Range(1e-3, 3600, "s")] = 0.5

    def __post_init__(self) -> None:
        require_in_range(self)

    def tilts(self, time_s: Float, rng: np.random.Generator) -> Float:
        """Roll and pitch (T, 2) at times (T,)."""
        drawn = rng.standard_normal((len(time_s), 2))
        left = np.exp(-np.diff(time_s) / self.correlation_s)
        tilt = np.array(drawn)
        for k, share in enumerate(left.tolist(), start=1):
            tilt[k] = share * tilt[k - 1] + np.sqrt(1 - share**2) * drawn[k]
        return self.sigma_rad * tilt


@dataclass(frozen=True)
class AttitudeNoise:
    """What a robot whose body sways is told of its roll and pitch.

    Attributes:
        measured: whether it is told anything; else it takes itself for level.
        sigma_rad: standard deviation of either, anew in each frame.
    """

    measured: bool = True
    sigma_rad: Annotated[float, Range(0, 1, "rad")] = _THREE_TENTHS_RAD

    def __post_init__(self) -> None:
        require_in_range(self)

    def applied(self, tilt_rad: Float, rng: np.random.Generator) -> Float:
        """Roll and pitch (T, 2) as measured."""
        return tilt_rad + self.sigma_rad * rng.standard_normal(tilt_rad.shape)
