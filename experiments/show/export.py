"""Tables as files: CSV for programs, Markdown for pages, LaTeX for papers."""

from pathlib import Path

import pandas as pd

from mapfusion.storage import write_whole

# What a reader of a page can use; the CSV keeps every digit.
_SIGNIFICANT_DIGITS = 4


def write_tables(folder: Path, tables: dict[str, pd.DataFrame]) -> None:
    """Write each table as NAME.csv, NAME.md and NAME.tex."""
    for name, table in tables.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False))
        write_text(folder / f"{name}.md", to_markdown(table))
        write_text(folder / f"{name}.tex", to_latex(table))


def write_text(path: Path, text: str) -> None:
    """Write a text file as a whole."""
    data = text.encode("utf-8", "backslashreplace")  # what a user gave may hold half characters
    write_whole(path, lambda file: file.write_bytes(data))


def to_markdown(table: pd.DataFrame) -> str:
    """A pipe table; pipes inside names are escaped."""
    shown = rounded(table).map(lambda text: text.replace("|", "\\|"))
    alignment = ["right" if name in _numbers(table) else "left" for name in table]
    return shown.to_markdown(index=False, disable_numparse=True, colalign=alignment) + "\n"


def to_latex(table: pd.DataFrame) -> str:
    """A booktabs table; names are escaped."""
    alignment = "".join("r" if name in _numbers(table) else "l" for name in table)
    return rounded(table).to_latex(index=False, escape=True, column_format=alignment)


def rounded(table: pd.DataFrame) -> pd.DataFrame:
    """All cells as text: four significant digits, a dash for what is not known."""
    return table.astype(object).map(_text).where(table.notna(), "-")


def _numbers(table: pd.DataFrame) -> set[str]:
    return set(table.select_dtypes("number").columns)


def _text(value: object) -> str:
    return f"{value:.{_SIGNIFICANT_DIGITS}g}" if isinstance(value, float) else str(value)
