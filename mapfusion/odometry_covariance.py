"""How sure a log's odometry is, step by step: a file beside the log, where that is known.

Wheels have the filter's motion noise; odometry from pictures has a covariance of its own, which
grows where little was seen.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.arguments import require_shape
from mapfusion.errors import InputError
from mapfusion.open_tables import told
from mapfusion.se2 import Float
from mapfusion.storage import (
    covariance_columns,
    covariances_from,
    float_fields,
    read_table,
    require_cells,
    require_one_row_a_frame,
    schema,
    write_table,
)

FILE = "odometry_covariance.parquet"
_FIELDS = ["cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt"]
ODOMETRY_COVARIANCE = schema(
    "robot_log.odometry_covariance",
    1,
    [
        told(pa.field("iteration", pa.int32()), "number of the frame: 0, 1, 2, ..."),
        *(
            told(field, "of the motion since the row before: m², m rad, rad²")
            for field in float_fields(_FIELDS)
        ),
    ],
)


def write_odometry_covariance(folder: Path, covariance: Float | None) -> None:
    """Write (T, 3, 3) of x, y, theta into a log's folder; None removes what is there."""
    if covariance is None:
        (folder / FILE).unlink(missing_ok=True)
        return
    n = len(covariance)
    require_shape("covariance", covariance, (n, 3, 3))
    iteration = np.arange(n, dtype=np.int32)
    rows = {"iteration": iteration, **covariance_columns(_FIELDS, covariance)}
    write_table(folder / FILE, rows, ODOMETRY_COVARIANCE)


def read_odometry_covariance(folder: Path, n_frames: int | None = None) -> Float | None:
    """Read the covariance (T, 3, 3) of a log's odometry; None if its folder holds none.

    Args:
        folder: of the log.
        n_frames: of the log; None if it is not known.

    Raises:
        InputError: the file is damaged, or not as documented.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    table, _ = read_table(path, ODOMETRY_COVARIANCE)
    require_one_row_a_frame(path, table, n_frames)
    require_cells(path, table, _FIELDS, np.isfinite, "give finite numbers, or remove the file")
    covariance = covariances_from(table, _FIELDS)
    low, high = np.linalg.eigvalsh(covariance[1:])[:, [0, -1]].T  # the first row has no motion
    wrong = np.flatnonzero(low <= np.finfo(float).eps * high)
    if len(wrong):
        row = wrong[0] + 1
        raise InputError(f"{path}: not positive definite in row {row}; mend it, or remove the file")
    return covariance
