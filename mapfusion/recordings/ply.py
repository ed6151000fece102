"""Landmarks as a cloud of points in the PLY format (Turk 1994), as MeshLab and Open3D read it."""

import numpy as np

from mapfusion.arguments import require_shape
from mapfusion.landmark_map import LandmarkMap

_PROPERTIES = (
    *(f"double {name}" for name in ("x", "y", "z")),
    *(f"uchar {name}" for name in ("red", "green", "blue")),
    *(f"double sigma_{axis}" for axis in "xyz"),
    "int count",
)


def ply_text(landmarks: LandmarkMap, rgb: np.ndarray) -> str:
    """A map with a colour (N, 3), 0 to 255, for each landmark.

    Properties: x, y, z in metres in the frame of the map; red, green, blue; sigma_x, sigma_y,
    sigma_z, the standard deviations in metres along the axes (0 for the height of planar maps);
    count, how often the landmark was seen. Every number is read back exactly.
    """
    n = len(landmarks)
    require_shape("rgb", rgb, (n, 3))
    sigma_m = np.sqrt(np.diagonal(landmarks.covariance_m2, axis1=1, axis2=2))
    parts = (landmarks.position_m, rgb.astype(int), sigma_m, landmarks.count[:, None].astype(int))
    columns = [column for part in parts for column in part.T.tolist()]
    header = ["ply", "format ascii 1.0", f"comment map of {landmarks.name}, metres"]
    header += [f"element vertex {n}", *(f"property {each}" for each in _PROPERTIES), "end_header"]
    lines = (" ".join(map(str, row)) for row in zip(*columns, strict=True))
    return "\n".join([*header, *lines, ""])
