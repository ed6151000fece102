"""The tables of `experiments/docs/formats.md`: `python -m experiments.show.formats`."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from experiments.judge import tables
from experiments.show.export import write_text
from experiments.show.inspect import unit_of
from mapfusion import (
    attitude,
    joint_files,
    landmark_map,
    odometry_covariance,
    robot_log,
    viewing_files,
)
from mapfusion.joint_covariance import RANK
from mapfusion.open_tables import HEIGHT, about, default_of

PAGE = Path(__file__).parents[1] / "docs" / "formats.md"
TABLES_BEGIN = "<!-- From here on made by `python -m experiments.show.formats` -->"
_OPEN = {
    "A map: one file, `NAME.parquet` or `NAME.csv`": landmark_map.LANDMARKS,
    "A map's joint covariance: `NAME.joint.parquet` beside it, one row a landmark": (
        joint_files.joint_schema(RANK)
    ),
    "A map's viewing evidence: `NAME.viewing.parquet` beside it, one row a landmark": (
        viewing_files.VIEWING
    ),
    "A map's viewing evidence: `NAME.frames.parquet` beside it, one row a frame": (
        viewing_files.VIEWED_FRAMES
    ),
    "A log: `frames`, one row an iteration, also of those that saw nothing": robot_log.FRAMES,
    "A log: `observations`, one row a sighting": robot_log.OBSERVATIONS,
    f"A log's odometry covariance: `{odometry_covariance.FILE}`, optional, one row an iteration": (
        odometry_covariance.ODOMETRY_COVARIANCE
    ),
    f"A log's attitude: `{attitude.FILE}`, optional, one row an iteration": attitude.ATTITUDE,
    "A log's truth: `truth_poses`, one row an iteration": robot_log.TRUTH_POSES,
    "A log's truth: `truth_points`, one row an observation, in their order": robot_log.TRUTH_POINTS,
}


def page(text: str) -> str:
    """The page with its tables as the schemas say; what stands before them is kept."""
    return "\n".join([text.partition(TABLES_BEGIN)[0] + TABLES_BEGIN, *_lines(), ""])


def _lines() -> Iterator[str]:
    for title, schema in _OPEN.items():
        yield from (
            f"\n## {title}\n",
            "| column | type | unit | if absent | meaning |",
            "|---" * 5 + "|",
        )
        for field in schema:
            yield _row(field.name, field.type, _if_absent(field), about(field))
    yield "\n## A result: `RESULT/tables/*.parquet`\n"
    yield "What the rows are, `experiments/judge/tables.py` says. All columns are there.\n"
    yield from ("| table | column | type | unit |", "|---" * 4 + "|")
    for name, schema in tables.ALL.items():
        for field in schema:
            yield f"| {name} {_row(field.name, field.type)}"


def _row(name: str, kind: pa.DataType, *more: str) -> str:
    shown = f"{kind.list_size} × {kind.value_type}" if pa.types.is_fixed_size_list(kind) else kind
    return "| " + " | ".join([f"`{name}`", str(shown), unit_of(name), *more]) + " |"


def _if_absent(field: pa.Field) -> str:
    if field.name in HEIGHT:
        return "planar, if all four are"
    default = default_of(field)
    if default is None:
        return "required"
    return "none" if np.isnan(default) else f"{default:g}"


if __name__ == "__main__":
    write_text(PAGE, page(PAGE.read_text(encoding="utf-8")))
