"""`mapfusion inspect` on every file of a run, and on files that are not as they should be."""

import shutil
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from experiments.evaluation import tables
from experiments.reports.inspect import contents_of, unit_of
from mapfusion.files import read_json, schema, write_json, write_table
from tests.helpers.tiny_scenario import command


def test_every_file_of_a_run_is_told(
    tiny_results: Path, tiny_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [tiny_path, *tiny_results.rglob("*.json")]
    paths += [folder for folder in tiny_results.rglob("*") if list(folder.glob("*.parquet"))]
    by_kind = {contents_of(path).kind: path for path in tiny_results.rglob("*.parquet")}
    assert set(by_kind) >= {t.metadata[b"mapfusion.kind"].decode() for t in tables.ALL.values()}
    for path in [*paths, *by_kind.values(), tiny_results / "store", tiny_results / "tiny-3"]:
        reply = command(capsys, "inspect", path)
        assert (reply.code, reply.complaints) == (0, []), path
        assert str(path) in reply.out.splitlines()[0]


def test_kind_version_rows_and_columns_are_those_of_the_table(tiny_result: Path) -> None:
    path = tables.table_path(tiny_result, "errors")
    rows, found = tables.read(path, "errors"), contents_of(path)
    assert (found.kind, found.facts["schema_version"]) == ("result.errors", "6")
    assert found.facts["rows"] == len(rows)
    assert [name for name, _ in found.columns] == ["column", "type", "unit"]
    told = {name: (kind, unit) for name, kind, unit in found.rows}
    assert list(told) == list(rows)
    assert told["translation_error_m"] == ("double", "m")
    assert told["refined_rotation_error_rad"] == ("double", "rad")
    assert told["n_true"] == ("int32", "")


def test_a_result_tells_its_scenario_provenance_and_tables(tiny_result: Path) -> None:
    found = contents_of(tiny_result)
    assert found.kind == "result of a run"
    assert (found.facts["name"], found.facts["seed"]) == ("tiny", 3)
    assert {"renderer", "python", "written"} <= set(found.facts)
    rows = {holds: n_rows for holds, _, n_rows in found.rows}
    for name in tables.ALL:
        table = tables.read(tables.table_path(tiny_result, name), name)
        assert rows[f"tables/{name}"] == len(table)


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("x_m", "m"),
        ("cov_xy_m2", "m²"),
        ("cov_xt", "m rad"),
        ("final_theta_rad", "rad"),
        ("elapsed_s", "s"),
        ("u_px", "px"),
        ("count", ""),
        ("status", ""),
        ("s", ""),
    ],
)
def test_units_come_from_the_names(name: str, unit: str) -> None:
    assert unit_of(name) == unit


def test_a_recorded_log(tiny_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(tiny_log, tmp_path / "R1")
    (tmp_path / "R1" / "done.json").unlink()
    reply = command(capsys, "inspect", tmp_path / "R1")
    assert reply.code == 0
    assert "robot log" in reply.out
    assert "truth_poses" in reply.out
    assert "44" in reply.out
    assert "folder of robot logs" in command(capsys, "inspect", tmp_path).out


def test_a_kind_it_does_not_know_describes_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sweep.parquet"
    fields = [pa.field("[bold]", pa.string()), pa.field("elapsed_s", pa.float64())]
    columns = {"[bold]": ["a"], "elapsed_s": [0.1]}
    write_table(path, columns, schema("sweep.new", 7, fields))
    reply = command(capsys, "inspect", path)
    assert reply.code == 0
    assert "sweep.new, schema version 7" in reply.out
    assert "[bold]" in reply.out  # as text, no markup


def test_maps_of_other_programs_as_align_reads_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = pd.DataFrame({"x_m": [0.0, 1.0], "y_m": [0.0, 2.0], "cov_xx_m2": 0.01})
    frame = frame.assign(cov_xy_m2=0.0, cov_yy_m2=0.01)
    frame.assign(label=[3, 4]).to_csv(tmp_path / "north.csv", index=False)
    frame.to_parquet(tmp_path / "south.parquet")
    for name, by in (("north.csv", "labels"), ("south.parquet", "geometry alone")):
        reply = command(capsys, "inspect", tmp_path / name)
        assert reply.code == 0
        assert f"{name}: landmark_map" in reply.out.replace("\n", " ")
        assert "rows: 2" in reply.out
        assert "planar: true" in reply.out
        assert f"matched by: {by}" in reply.out
    frame.drop(columns="cov_yy_m2").to_csv(tmp_path / "west.csv", index=False)
    reply = command(capsys, "inspect", tmp_path / "west.csv")
    assert reply.code == 2
    assert "west.csv: has no column cov_yy_m2" in reply.err


def test_logs_of_other_programs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    motion = dict.fromkeys(("odometry_x_m", "odometry_y_m", "odometry_theta_rad"), 0.0)
    frames = pd.DataFrame({"iteration": [0, 1], "time_s": [0.0, 0.1]} | motion)
    point = {"x_m": 1.0, "y_m": 2.0, "cov_xx_m2": 0.01, "cov_xy_m2": 0.0, "cov_yy_m2": 0.01}
    seen = pd.DataFrame({"iteration": [0, 1, 1], "label": [0, 0, 1]} | point)
    (tmp_path / "R7").mkdir()
    frames.to_csv(tmp_path / "R7" / "frames.csv", index=False)
    seen.to_csv(tmp_path / "R7" / "observations.csv", index=False)
    assert "robot: R7" in command(capsys, "inspect", tmp_path / "R7").out
    assert "folder of robot logs" in command(capsys, "inspect", tmp_path).out
    reply = command(capsys, "inspect", tmp_path / "R7" / "observations.csv")
    assert reply.code == 0
    assert "robot_log.observations" in reply.out
    assert "rows: 3" in reply.out


def test_what_each_column_is_read_as(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frame = pd.DataFrame({"x_m": [0.0, 1.0], "y_m": [0.0, 2.0], "cov_xx_m2": 0.01})
    frame = frame.assign(cov_xy_m2=0.0, cov_yy_m2=0.01, id=[1, 2], weight=0.5)
    numbers = {f"d{k}": [0.1, 0.2] for k in range(4)}
    frame.assign(**numbers).to_csv(tmp_path / "north.csv", index=False)
    found = contents_of(tmp_path / "north.csv")
    assert found.facts["ignored columns"] == "id, weight"
    sources = {row[0]: row[-1] for row in found.rows}
    assert sources["descriptor"] == "d0 to d3"
    assert (sources["x_m"], sources["label"]) == ("x_m", "not given")
    frame.to_csv(tmp_path / "north.csv", index=False)
    assert command(capsys, "inspect", tmp_path / "north.csv").err.count("id is ignored") == 1
    seen = pd.DataFrame({"time_s": [0.0], "range_m": [1.0], "bearing_rad": [0.1], "snr": [9.0]})
    seen.to_csv(tmp_path / "ranges.csv", index=False)
    assert contents_of(tmp_path / "ranges.csv").facts["ignored columns"] == "snr"


def truncated(result: Path, folder: Path) -> Path:
    path = folder / "cut.parquet"
    path.write_bytes(tables.table_path(result, "errors").read_bytes()[:-100])
    return path


def foreign(result: Path, folder: Path) -> Path:
    path = folder / "foreign.parquet"
    pd.DataFrame({"a": [1]}).to_parquet(path)
    return path


def of_another_version(result: Path, folder: Path) -> Path:
    path = folder / "newer.parquet"
    table = pq.read_table(tables.table_path(result, "errors"))
    metadata = dict(table.schema.metadata) | {b"mapfusion.schema_version": b"99"}
    pq.write_table(table.replace_schema_metadata(metadata), path)
    return path


def with_a_column_less(result: Path, folder: Path) -> Path:
    path = folder / "less.parquet"
    table = pq.read_table(tables.table_path(result, "errors"))
    pq.write_table(table.drop_columns(["n_true"]), path)
    return path


def no_json(result: Path, folder: Path) -> Path:
    path = folder / "provenance.json"
    path.write_text('{"schema_version": 1')
    return path


def other_json(result: Path, folder: Path) -> Path:
    path = folder / "package.json"
    path.write_text('{"name": "else"}')
    return path


def resolved_but_wrong(result: Path, folder: Path) -> Path:
    path = folder / "scenario.json"
    write_json(path, read_json(result / "scenario.json", "scenario") | {"seed": -3})
    return path


def damaged_result(result: Path, folder: Path) -> Path:
    path = Path(shutil.copytree(result, folder / "result"))
    (path / "tables" / "clouds.parquet").write_bytes(b"")
    return path


def empty_folder(result: Path, folder: Path) -> Path:
    return folder


def absent(result: Path, folder: Path) -> Path:
    return folder / "absent.parquet"


def picture(result: Path, folder: Path) -> Path:
    return next((result / "keyframes").glob("*.png"))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (truncated, "damaged or not a Parquet file"),
        (foreign, "none of mapfusion's"),
        (of_another_version, "schema_version is 99"),
        (with_a_column_less, "columns are not those of result.errors"),
        (no_json, "no JSON object"),
        (other_json, "no file of mapfusion's"),
        (resolved_but_wrong, "seed"),
        (damaged_result, "clouds.parquet: damaged"),
        (empty_folder, "no folder of mapfusion's"),
        (absent, "no such file"),
        (picture, "no file of mapfusion's"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    make, said: str, tiny_result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make(tiny_result, tmp_path)
    reply = command(capsys, "inspect", path)
    assert reply.code == 2
    assert len(reply.complaints) == 1
    assert reply.err.strip().count("\n") == 0
    assert said in reply.complaints[0]
    assert str(path) in reply.complaints[0]
