"""What the calibration of a recorded camera leaves open: errors that all of a robot's map share.

Whoever calibrates a pair of cameras and measures its mount errs once, and every observation is off
by the same. No residual within one map shows it: a map turned about its beginning, or larger by a
share, fits itself as well. Between the maps of two robots it does: T_a_b and what is fused by it
are no surer than the cameras are. Robots whose cameras were calibrated alike err alike, and no
number of them averages it out. Simulated cameras are known exactly.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.arguments import Range, require_in_range
from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.se2 import Float

# Of the middle of a rectified image: checkerboards tell it to about a pixel, and to no more once
# lens and pair were moved to another day's temperature.
_PRINCIPAL_PX = 1.0
_MOUNT_RAD = 0.002  # of the camera's heading on its robot: what measuring a mount reaches, 0.1 deg
# Of depths, by focal length, baseline and the right camera's turn: KITTI's published calibration
# leaves some tenths of a percent (Kreso and Segvic 2015, "Improving the egomotion estimation by
# correcting the calibration bias").
_SCALE = 0.003
_ATTRIBUTES = {"heading_rad": "calibration_heading_rad", "scale": "calibration_scale"}
N_OF_CAMERA = len(_ATTRIBUTES)  # independent errors of a camera
_CAMERA_ATTRIBUTE = "calibration_camera"


@dataclass(frozen=True)
class CalibrationError:
    """Standard deviations of what one robot's observations have in common; independent.

    Attributes:
        heading_rad: of the camera's heading in the robot's frame: its mount, and the middle of its
            image.
        scale: of all lengths, as a share: focal length and baseline.
        camera: whose errors they are: robots that name the same one err alike. Empty: the robot's
            own.
    """

    heading_rad: Annotated[float, Range(0, 1, "rad")] = 0.0
    scale: Annotated[float, Range(0, 1, "1")] = 0.0
    camera: str = ""

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def is_none(self) -> bool:
        """Whether the camera is known exactly."""
        return self.heading_rad == 0 and self.scale == 0

    def is_of_one_camera(self, other: "CalibrationError") -> bool:
        """Whether the other robot's errors are the same."""
        return self.camera != "" and self.camera == other.camera

    def moves_m(self, position_m: Float) -> Float:
        """How far one sigma of each error moves points (N, 2 or 3) of the robot's map: (N, 2, 3).

        In the plane: the map turns about its beginning, and grows. Heights are of the order of the
        camera's own, and roll and pitch are in the observations' covariances.
        """
        x, y = position_m[:, 0], position_m[:, 1]
        moved = np.zeros((len(position_m), N_OF_CAMERA, 3))
        moved[:, 0, 0], moved[:, 0, 1] = -self.heading_rad * y, self.heading_rad * x
        moved[:, 1, 0], moved[:, 1, 1] = self.scale * x, self.scale * y
        return moved

    def attributes(self) -> dict[str, str]:
        """As files have it in their metadata; nothing of a camera that is known exactly."""
        if self.is_none:
            return {}
        told = {key: repr(float(getattr(self, name))) for name, key in _ATTRIBUTES.items()}
        return told | ({_CAMERA_ATTRIBUTE: self.camera} if self.camera else {})


EXACT = CalibrationError()


def calibration_from(attributes: Mapping[str, str], where: object) -> CalibrationError:
    """What a file's metadata tell, EXACT where they tell nothing; raises InputError."""
    try:
        told = {name: float(attributes.get(key, "0")) for name, key in _ATTRIBUTES.items()}
        return CalibrationError(**told, camera=attributes.get(_CAMERA_ATTRIBUTE, ""))
    except ValueError as error:
        keys = " and ".join(_ATTRIBUTES.values())
        raise InputError(f"{where}: {keys} in its metadata: {error}") from error


def usual_calibration(camera: StereoCamera) -> CalibrationError:
    """Of a camera that somebody calibrated, and said no more."""
    return CalibrationError(math.hypot(_PRINCIPAL_PX / camera.focal_px, _MOUNT_RAD), _SCALE)
