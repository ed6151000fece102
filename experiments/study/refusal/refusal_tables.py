"""The tables of the experiment `refusal`, in `FOLDER/tables/`."""

from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from experiments.judge.tables import table_path
from experiments.run.frames import read_rows, write_rows
from mapfusion.storage import schema


def _fields(**types: pa.DataType) -> list[pa.Field]:
    return [pa.field(name, kind) for name, kind in types.items()]


# One row per (pair of maps, aligner) of the experiment `refusal`; errors are NaN for maps of two
# worlds. Ground is apart, common, posters, few or repeated (see cases.py).
REFUSALS = schema(
    "refusal.refusals",
    1,
    _fields(
        ground=pa.string(),
        poster_radius_m=pa.float64(),  # NaN without a poster
        world_a=pa.string(),
        robot_a=pa.string(),
        world_b=pa.string(),
        robot_b=pa.string(),
        iteration=pa.int32(),
        aligner=pa.string(),
        n_correspondences=pa.int32(),
        n_true=pa.int32(),
        n_common=pa.int32(),
        n_inliers=pa.int32(),  # of the refined alignment: what a threshold on support would go by
        accepted=pa.bool_(),
        log10_false_alarms=pa.float64(),
        refined_translation_error_m=pa.float64(),
        refined_rotation_error_rad=pa.float64(),
    ),
)

# The test itself on made-up maps of walls with random pairs, over every motion of two pairs.
CALIBRATION = schema(
    "refusal.calibration",
    1,
    _fields(
        stated=pa.float64(),  # expected number of false alarms accepted
        motions_a_pair=pa.float64(),  # mean number of motions accepted on a pair of maps
        n_accepted=pa.int32(),  # pairs of maps with at least one
        n_pairs=pa.int32(),
    ),
)

ALL = {"refusals": REFUSALS, "calibration": CALIBRATION}


def write(folder: Path, name: str, rows: list[dict[str, Any]]) -> None:
    """Write the table of that name."""
    write_rows(table_path(folder, name), ALL[name], rows)


def read(folder: Path, name: str) -> pd.DataFrame:
    """Read the table of that name; raises InputError that names the file."""
    return read_rows(table_path(folder, name), ALL[name])
