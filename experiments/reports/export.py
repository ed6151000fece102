"""Tables as CSV, Markdown and LaTeX, and the page that documents the columns of all files."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.evaluation import tables
from experiments.reports.inspect import unit_of
from mapfusion import attitude, landmark_map, robot_log, viewing
from mapfusion.files import write_whole
from mapfusion.geometry.joint_covariance import RANK
from mapfusion.tables import HEIGHT, default_of, description_of

_SIGNIFICANT_DIGITS = 4  # in Markdown and LaTeX; CSV files have all digits


def write_tables(folder: Path, tables: dict[str, pd.DataFrame]) -> None:
    """Write each table as NAME.csv, NAME.md and NAME.tex."""
    for name, table in tables.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False))
        write_text(folder / f"{name}.md", to_markdown(table))
        write_text(folder / f"{name}.tex", to_latex(table))


def write_text(path: Path, text: str) -> None:
    """Write a text file as a whole."""
    data = text.encode("utf-8", "backslashreplace")  # text of users may contain lone surrogates
    write_whole(path, lambda file: file.write_bytes(data))


def to_markdown(table: pd.DataFrame) -> str:
    """Return a Markdown pipe table; pipes inside names are escaped."""
    shown = rounded(table).map(lambda text: text.replace("|", "\\|"))
    alignment = ["right" if name in _numbers(table) else "left" for name in table]
    return shown.to_markdown(index=False, disable_numparse=True, colalign=alignment) + "\n"


def to_latex(table: pd.DataFrame) -> str:
    """Return a LaTeX booktabs table; names are escaped."""
    alignment = "".join("r" if name in _numbers(table) else "l" for name in table)
    return rounded(table).to_latex(index=False, escape=True, column_format=alignment)


def rounded(table: pd.DataFrame) -> pd.DataFrame:
    """Return all cells as text: four significant digits, and a dash for unknown values."""

    def text(value: object) -> str:
        return f"{value:.{_SIGNIFICANT_DIGITS}g}" if isinstance(value, float) else str(value)

    return table.astype(object).map(text).where(table.notna(), "-")


def _numbers(table: pd.DataFrame) -> set[str]:
    return set(table.select_dtypes("number").columns)


PAGE = Path(__file__).parents[1] / "docs" / "formats.md"
TABLES_BEGIN = "<!-- From here on made by `python -m experiments.reports.export` -->"
_OPEN = {
    "A map: one file, `NAME.parquet` or `NAME.csv`": landmark_map.LANDMARKS,
    "A map's joint covariance: `NAME.joint.parquet` beside it, one row a landmark": (
        landmark_map.joint_schema(RANK)
    ),
    "A map's viewing evidence: `NAME.viewing.parquet` beside it, one row a landmark": (
        viewing.VIEWING
    ),
    "A map's viewing evidence: `NAME.frames.parquet` beside it, one row a frame": (
        viewing.VIEWED_FRAMES
    ),
    "A log: `frames`, one row an iteration, also of those that saw nothing": robot_log.FRAMES,
    "A log: `observations`, one row a sighting": robot_log.OBSERVATIONS,
    f"A log's odometry covariance: `{robot_log.FILE}`, optional, one row an iteration": (
        robot_log.ODOMETRY_COVARIANCE
    ),
    f"A log's attitude: `{attitude.FILE}`, optional, one row an iteration": attitude.ATTITUDE,
    "A log's truth: `truth_poses`, one row an iteration": robot_log.TRUTH_POSES,
    "A log's truth: `truth_points`, one row an observation, in their order": robot_log.TRUTH_POINTS,
}


def page(text: str) -> str:
    """Return the page with the tables of the schemas; text before the tables is kept."""
    lines = [text.partition(TABLES_BEGIN)[0] + TABLES_BEGIN]
    for title, schema in _OPEN.items():
        lines.append(f"\n## {title}\n")
        lines += ["| column | type | unit | if absent | meaning |", "|---" * 5 + "|"]
        for field in schema:
            default = default_of(field)
            if field.name in HEIGHT:
                absent = "planar, if all four are"
            elif default is None:
                absent = "required"
            else:
                absent = "none" if np.isnan(default) else f"{default:g}"
            lines.append(_row(field.name, field.type, absent, description_of(field)))
    lines.append("\n## A result: `RESULT/tables/*.parquet`\n")
    lines.append(
        "`experiments/evaluation/tables.py` describes the rows. All columns are present.\n"
    )
    lines += ["| table | column | type | unit |", "|---" * 4 + "|"]
    for name, schema in tables.ALL.items():
        lines += [f"| {name} {_row(field.name, field.type)}" for field in schema]
    return "\n".join([*lines, ""])


def _row(name: str, kind: pa.DataType, *more: str) -> str:
    shown = f"{kind.list_size} × {kind.value_type}" if pa.types.is_fixed_size_list(kind) else kind
    return "| " + " | ".join([f"`{name}`", str(shown), unit_of(name), *more]) + " |"


if __name__ == "__main__":
    write_text(PAGE, page(PAGE.read_text(encoding="utf-8")))
