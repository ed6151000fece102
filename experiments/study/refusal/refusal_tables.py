"""The tables of the experiment `refusal`, in `FOLDER/tables/`."""

from pathlib import Path
from typing import Any

import pandas as pd

from experiments.judge.tables import table_path
from experiments.run.frames import BOOL, FLOAT, INT, TEXT, fields, read_rows, write_rows
from mapfusion.storage import schema

# One row per (pair of maps, aligner) of the experiment `refusal`; errors are NaN for maps of two
# worlds. Ground is apart, common, posters, few or repeated (see cases.py).
REFUSALS = schema(
    "refusal.refusals",
    1,
    fields(
        ground=TEXT,
        poster_radius_m=FLOAT,  # NaN without a poster
        world_a=TEXT,
        robot_a=TEXT,
        world_b=TEXT,
        robot_b=TEXT,
        iteration=INT,
        aligner=TEXT,
        n_correspondences=INT,
        n_true=INT,
        n_common=INT,
        n_inliers=INT,  # of the refined alignment: what a threshold on support would go by
        accepted=BOOL,
        log10_false_alarms=FLOAT,
        refined_translation_error_m=FLOAT,
        refined_rotation_error_rad=FLOAT,
    ),
)

# The test itself on made-up maps of walls with random pairs, over every motion of two pairs.
CALIBRATION = schema(
    "refusal.calibration",
    1,
    fields(
        stated=FLOAT,  # expected number of false alarms accepted
        motions_a_pair=FLOAT,  # mean number of motions accepted on a pair of maps
        n_accepted=INT,  # pairs of maps with at least one
        n_pairs=INT,
    ),
)

ALL = {"refusals": REFUSALS, "calibration": CALIBRATION}


def write(folder: Path, name: str, rows: list[dict[str, Any]]) -> None:
    """Write the table of that name."""
    write_rows(table_path(folder, name), ALL[name], rows)


def read(folder: Path, name: str) -> pd.DataFrame:
    """Read the table of that name; raises InputError that names the file."""
    return read_rows(table_path(folder, name), ALL[name])
