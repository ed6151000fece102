"""The command that shows that two folders of tables hold the same values."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.same_values import read_folder, same_values

TABLE = pd.DataFrame(
    {
        "robot": ["R1", "R2", ""],
        "error_m": [1.5, np.nan, 0.0],
        "descriptor": [[0.5, np.nan], [1.0, 2.0], []],
        "inliers": [b"\x01", b"", None],
        "elapsed_s": [1.0, 2.0, 3.0],
    }
)


def write(folder: Path, table: pd.DataFrame = TABLE, name: str = "tables/errors") -> Path:
    path = folder / f"{name}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    table.to_parquet(path)
    return folder


def test_the_same_values_are_equal_whatever_the_times(tmp_path: Path) -> None:
    before = write(tmp_path / "before")
    changed = TABLE.assign(elapsed_s=9.0)[[*reversed(TABLE.columns)]]
    after = write(tmp_path / "after", changed)
    write(write(before, name="tables/timings"), name="store/slam/0123/poses")
    assert same_values(before, after)


@pytest.mark.parametrize(
    ("column", "row", "value", "words"),
    [
        ("error_m", 0, np.nextafter(1.5, 2), "error_m: 1 of 3 rows, first row 0"),
        ("error_m", 1, 0.0, "error_m: 1 of 3 rows, first row 1"),
        ("error_m", 2, -0.0, "error_m: 1 of 3 rows, first row 2"),
        ("robot", 2, "R3", "robot: 1 of 3 rows, first row 2: '' -> 'R3'"),
        ("descriptor", 0, [0.5, 1.0], "descriptor: 1 of 3 rows, first row 0"),
        ("inliers", 2, b"", "inliers: 1 of 3 rows, first row 2"),
    ],
)
def test_one_other_value_is_found_and_named(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    column: str,
    row: int,
    value: object,
    words: str,
) -> None:
    values = [*TABLE[column]]
    values[row] = value
    other = TABLE.assign(**{column: values})
    assert not same_values(write(tmp_path / "before"), write(tmp_path / "after", other))
    assert words in capsys.readouterr().out


def test_missing_rows_columns_and_tables_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = write(write(tmp_path / "before"), name="tables/gone")
    after = write(write(tmp_path / "after", TABLE[:2].assign(more=1)), name="tables/new")
    assert not same_values(before, after)
    out = capsys.readouterr().out
    assert "column more only after" in out
    assert "robot: 3 rows before, 2 after" in out
    assert "tables/gone.parquet  DIFFERS only before" in out
    assert "tables/new.parquet  DIFFERS only after" in out


def test_the_hash_tells_columns_and_rows_apart(tmp_path: Path) -> None:
    folder = write(tmp_path, TABLE, "a")
    write(folder, TABLE.rename(columns={"robot": "map"}), "b")
    write(folder, TABLE[::-1], "c")
    write(folder, TABLE.assign(elapsed_s=0.0), "d")
    sha256 = {name: values.sha256 for name, values in read_folder(folder).items()}
    assert len(set(sha256.values())) == 3
    assert sha256["a.parquet"] == sha256["d.parquet"]


def test_a_folder_without_tables_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="nothing: holds no tables"):
        same_values(write(tmp_path / "before"), tmp_path / "nothing")
