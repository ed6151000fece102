"""What the level of a recording's robot may be known from; what finds it takes long to import."""

from typing import Literal

Level = Literal["auto", "mount", "pictures", "floor", "imu", "odometry"]
