"""Trajectories in the TUM format, as evo and others read them.

One pose a line: time in seconds, position in metres, orientation as a quaternion with its real part
last (Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems").
"""

from collections.abc import Iterator

import numpy as np

from mapfusion.arguments import require_shape
from mapfusion.se2 import Float

_COLUMNS = "# timestamp_s tx_m ty_m tz_m qx qy qz qw"


def tum_text(time_s: Float, T_frame_robot: Float, about: str) -> str:
    """Poses (T, 3) in the plane at times (T,); those that are not known (NaN) are left out.

    Every number is written so that it is read back exactly.
    """
    require_shape("T_frame_robot", T_frame_robot, (len(time_s), 3))
    return "\n".join([f"# {about}", _COLUMNS, *_lines(time_s, T_frame_robot), ""])


def _lines(time_s: Float, T_frame_robot: Float) -> Iterator[str]:
    known = np.isfinite(T_frame_robot).all(axis=1)
    for when, (x, y, theta) in zip(time_s[known].tolist(), T_frame_robot[known], strict=True):
        qz, qw = float(np.sin(theta / 2)), float(np.cos(theta / 2))
        yield f"{when} {float(x)} {float(y)} 0 0 0 {qz} {qw}"
