"""Tables of stages and their schemas, without the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from mapfusion.files import covariances_from, read_table, schema, write_table
from mapfusion.geometry.numerics import Float

# Commands that only read tables are quicker without pandas.
if TYPE_CHECKING:
    import pandas as pd


TEXT, INT, FLOAT, BOOL = pa.string(), pa.int32(), pa.float64(), pa.bool_()


def fields(**types: pa.DataType) -> list[pa.Field]:
    """Return schema fields from names and types."""
    return [pa.field(name, kind) for name, kind in types.items()]


def write_rows(
    path: Path,
    table_schema: pa.Schema,
    rows: pd.DataFrame | list[dict[str, Any]],
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write rows as a table with a schema and further text attributes."""
    import pandas as pd

    frame = pd.DataFrame(rows, columns=pd.Index(table_schema.names))
    columns = {column: frame[column].to_numpy() for column in frame}
    write_table(path, columns, table_schema, attributes)


def read_rows(path: Path, table_schema: pa.Schema) -> pd.DataFrame:
    """Read a table with a schema; raises InputError that names the file."""
    table, _ = read_table(path, table_schema)
    return table.to_pandas(use_threads=False)


def at_iteration(rows: pd.DataFrame, iteration: int) -> pd.DataFrame:
    """Return the rows of one iteration from a table that is sorted by iteration."""
    return rows.iloc[slice(*rows["iteration"].searchsorted([iteration, iteration + 1]))]


def records(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows as dicts, for few rows and many columns faster than pandas."""
    names = rows.columns.tolist()
    columns = (rows[name].tolist() for name in names)
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


MOTION = ("tx_m", "ty_m", "theta_rad")
COVARIANCE = ("cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt")  # m2, m rad, rad2
_MAPS = {"robot_a": TEXT, "robot_b": TEXT, "iteration": INT}
_ANSWER = {"status": TEXT, "reason": TEXT} | dict.fromkeys(MOTION, FLOAT)

# Estimates of the aligners, written by the align stage.
ESTIMATES = schema(
    "result.estimates",
    5,
    fields(
        **_MAPS,
        aligner=TEXT,
        repetition=INT,
        n_correspondences=INT,
        **_ANSWER,
        **{f"refined_{name}": kind for name, kind in _ANSWER.items()},
        # of the refined alignment; NaN without an alignment or without evidence
        verdict=TEXT,
        accepted=BOOL,
        log10_false_alarms=FLOAT,
        log10_evidence=FLOAT,
        log10_ratio_passed=FLOAT,  # infinite if the alignment passes any `least_ratio`
        n_confirmed=INT,
        n_contradicted=INT,
        acceptance_reason=TEXT,
        drift_sigma_m=FLOAT,
        # upper triangle of the refined alignment's covariance
        **dict.fromkeys(COVARIANCE, FLOAT),
        lower_bound=BOOL,  # a map does not state the errors that its landmarks share
        # one bit per correspondence, most significant first (numpy.packbits)
        inliers=pa.binary(),
        refined_inliers=pa.binary(),
    ),
)

# Correspondences given to the aligners: rows of the two maps at the iteration.
_OFFERED = fields(**_MAPS, index_a=INT, index_b=INT, descriptor_distance=FLOAT)
CORRESPONDENCES = schema("result.correspondences", 1, _OFFERED)

# Best distinct motions between two maps (of: "a b"), and of each map onto itself ("a", "b").
# log10_evidence: evidence of the first motion, as in the estimates; own_share, copied_share: shares
# of landmarks that a wrong motion maps to similar ones, in regions without and with another motion;
# region_m: side of a region; copied_a, copied_b: landmarks that a motion maps to similar ones, one
# bit each.
RIVALS = schema(
    "result.rivals",
    3,
    fields(
        **_MAPS,
        of=TEXT,
        **dict.fromkeys(MOTION, FLOAT),
        log10_false_alarms=FLOAT,
        n_support=INT,
        n_confirmed=INT,
        n_contradicted=INT,
        n_regions=INT,
        log10_evidence=FLOAT,
        own_share=FLOAT,
        copied_share=FLOAT,
        region_m=FLOAT,
        copied_a=pa.binary(),
        copied_b=pa.binary(),
    ),
)

# Harris points of a few consecutive frames, for figure 1.
_POINT = fields(robot=TEXT, iteration=INT, track=pa.int64(), length=INT, u_px=FLOAT, v_px=FLOAT)
TRACKS = schema("result.tracks", 1, _POINT)


def covariances_of(rows: pd.DataFrame) -> Float:
    """Return covariances (n, 3, 3) of motions from the columns COVARIANCE."""
    columns = {name: rows[name].to_numpy(dtype=np.float64) for name in COVARIANCE}
    return covariances_from(pa.table(columns), COVARIANCE)
