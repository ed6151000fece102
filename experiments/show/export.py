"""Tables as files: CSV for programs, Markdown for pages, LaTeX for papers."""

from pathlib import Path

import numpy as np
import pandas as pd

from mapfusion.storage import write_whole

# What a reader of a page can use; the CSV keeps every digit.
_SIGNIFICANT_DIGITS = 4


def write_tables(folder: Path, tables: dict[str, pd.DataFrame]) -> list[Path]:
    """Write each table as NAME.csv, NAME.md and NAME.tex; returns the files."""
    written = []
    for name, table in tables.items():
        for suffix, text in (
            ("csv", table.to_csv(index=False)),
            ("md", to_markdown(table)),
            ("tex", to_latex(table)),
        ):
            path = folder / f"{name}.{suffix}"
            write_whole(path, lambda file, text=text: file.write_text(text, encoding="utf-8"))
            written.append(path)
    return written


def to_markdown(table: pd.DataFrame) -> str:
    """A pipe table; pipes inside names are escaped."""
    shown = rounded(table).map(lambda text: text.replace("|", "\\|"))
    return (
        shown.to_markdown(
            index=False,
            disable_numparse=True,
            colalign=["right" if name in _numbers(table) else "left" for name in table],
        )
        + "\n"
    )


def to_latex(table: pd.DataFrame) -> str:
    """A booktabs table; names are escaped."""
    alignment = "".join("r" if name in _numbers(table) else "l" for name in table)
    return rounded(table).to_latex(index=False, escape=True, column_format=alignment)


def rounded(table: pd.DataFrame) -> pd.DataFrame:
    """All cells as text: four significant digits, a dash for what is not known."""
    return table.astype(object).map(_text)


def _numbers(table: pd.DataFrame) -> set[str]:
    return set(table.select_dtypes("number").columns)


def _text(value: object) -> str:
    if isinstance(value, float | np.floating):
        return "-" if np.isnan(value) else f"{value:.{_SIGNIFICANT_DIGITS}g}"
    return "-" if value is None else str(value)
