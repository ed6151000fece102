"""Tests of `experiments.cli.options`."""

import io
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest
import typer
from typer.main import get_command

from experiments.cli.main import app
from experiments.cli.options import require_file, require_folder, require_map_file
from experiments.scenario.loading import OWN
from mapfusion.errors import InputError
from mapfusion.geometry import se2
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.landmark_map import LandmarkMap, read_map, write_map
from tests.helpers.made_up_maps import landmark_map
from tests.helpers.tiny_scenario import assert_refused, command

MAPS = ("a.parquet", "b.parquet")


def all_commands() -> dict[str, click.Command]:
    """Every command by its words."""
    top = get_command(app).commands  # type: ignore[attr-defined]
    below = {f"{a} {b}": c for a in top for b, c in getattr(top[a], "commands", {}).items()}
    return {name: each for name, each in (top | below).items() if not hasattr(each, "commands")}


def test_at_most_sixteen_commands_in_panels_in_the_order_of_a_day(
    capsys: pytest.CaptureFixture[str],
) -> None:
    top = get_command(app).commands  # type: ignore[attr-defined]
    assert len(top) <= 16
    shown = command(capsys, "--help").out
    panels = ["Run", "Look and compare", "Your own maps, logs and recordings"]
    places = [shown.index(f"─ {panel} ─") for panel in panels]
    assert places == sorted(places)
    assert "─ Commands ─" not in shown


def test_an_option_means_the_same_everywhere() -> None:
    helps: dict[str, set[str]] = {}
    for name, each in all_commands().items():
        for parameter in each.params:
            if isinstance(parameter, typer.core.TyperOption) and name != "sweep":
                helps.setdefault(parameter.opts[0], set()).add(parameter.help or "")
    # what is written differs, that it is written does not; pairs and trials are counted
    assert {name for name, texts in helps.items() if len(texts) > 1} <= {
        "--output",
        "--pairs",
        "--trials",
    }
    for name in ("run", "check", "sweep"):
        options = {option for each in all_commands()[name].params for option in each.opts}
        assert {"--results", "--set", "--jobs", "--output", "-o"} <= options
        assert options & {"--seed", "--seeds"}


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("align", *MAPS, "--set", "repetitions=3"), "align.repetitions"),
        (("align", *MAPS, "--set", "aligners.0.name=x"), "align.aligners.0.name"),
        (
            ("slam", "log", "-o", "m.parquet", "--set", "filter.n_particles=3"),
            "slam.filter.n_particles",
        ),
        (("merge", *MAPS, "-o", "m.parquet", "--set", "aligner=svd"), "merge.aligner"),
        (("run", "quick", "--set", "n_particles=3"), "slam.filter.n_particles"),
    ],
)
def test_keys_begin_at_the_root(
    arguments: tuple[str, ...], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    key = arguments[-1].partition("=")[0]
    assert_refused(command(capsys, *arguments), f"--set {key}: keys begin", f"root: {meant}\n")


@pytest.mark.parametrize("arguments", [("record",), ("align", *MAPS, "--scenario")])
def test_a_suite_name_is_taken_wherever_a_scenario_is(
    arguments: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert OWN.is_dir()
    wrong = ("--set", "slam.bogus=1", *(("-o", tmp_path / "x") if arguments == ("record",) else ()))
    assert_refused(command(capsys, *arguments, "quick", *wrong), "quick.yaml", "slam.bogus")
    assert_refused(command(capsys, *arguments, "full", *wrong), "full", "stands for 5 scenarios")
    assert_refused(command(capsys, *arguments, "nowhere", *wrong), "nowhere", "neither a file")


def test_one_folder_for_several_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reply = command(capsys, "run", "full", "-o", tmp_path / "x")
    assert_refused(reply, "--output", "5 runs", "--results")


T_A_B = np.array([1.0, -2.0, 0.3])
ONE = ("--set", "align.aligners=[{name: svd, method: svd}]", "--set", "merge.aligner=svd")
ROOT = Path(__file__).parents[3]


@pytest.fixture
def maps(tmp_path: Path) -> list[Path]:
    """Maps a and b of twenty labelled points, c of twenty others, as CSV."""
    rng = np.random.default_rng(0)
    p, other = rng.uniform(0, 10, (2, 20, 3))
    moved = se2.transform_points(se2.inverse(T_A_B), p)
    paths = []
    for name, position in (("a", p), ("b", moved), ("c", other)):
        label = np.arange(20, dtype=np.int32)
        paths.append(tmp_path / f"{name}.csv")
        write_map(paths[-1], replace(landmark_map(position, name), label=label))
    return paths


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def link(path: Path) -> Path:
    (path.parent / "link.csv").symlink_to(path.name)
    return path.parent / "link.csv"


def hard_link(path: Path) -> Path:
    os.link(path, path.parent / "hard.csv")
    return path.parent / "hard.csv"


def through_a_folder(path: Path) -> Path:
    (path.parent / "sub").symlink_to(path.parent)
    return path.parent / "sub" / path.name


def relative(path: Path) -> Path:
    return Path(os.path.relpath(path))


@pytest.mark.parametrize("name", [lambda path: path, link, hard_link, through_a_folder, relative])
def test_an_input_is_no_output_under_any_name(
    maps: list[Path], name: Callable[[Path], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    output = name(maps[0])
    before = contents(maps[0].parent)
    missing = maps[0].parent / "missing.csv"  # refused before anything is read
    assert_refused(command(capsys, "merge", *maps[:2], missing, "-o", output), "is an input")
    with pytest.raises(InputError, match="is an input"):
        require_file("--output", output, [".csv"], [maps[1], maps[0]])
    assert contents(maps[0].parent) == before


@pytest.mark.parametrize("name", [link, hard_link])
def test_a_file_of_a_log_is_no_output_under_another_name(
    tmp_path: Path, name: Callable[[Path], Path]
) -> None:
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "frames.csv").write_text("iteration\n")
    with pytest.raises(InputError, match="is a file of the log"):
        require_map_file(name(tmp_path / "log" / "frames.csv"), [tmp_path / "log"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("merge a.csv b.csv -o f.tum", ["ends in .tum", ".ply or .g2o", "mapfusion export"]),
        ("merge a.csv b.csv -o f.xyz", ["ends in .xyz", ".parquet or .csv or .ply or .g2o"]),
        ("merge a.csv b.csv -o f.g2o --report f.txt", ["--report f.txt", ".html"]),
        ("align a.csv b.csv --plot a.csv", ["--plot a.csv", "ends in .csv", ".png"]),
        ("align a.csv b.csv --report log", ["--report log: is a folder"]),
        ("merge a.csv b.csv -o f", ["has no ending", ".parquet or .csv"]),
        ("merge a.csv b.csv -o .", ["is a folder"]),
        ("merge a.csv b.csv -o b.joint.parquet", ["belongs to the map NAME.parquet"]),
        ("slam log -o m.frames.parquet", ["belongs to the map NAME.parquet (m.parquet)"]),
        ("align a.csv b.csv -o b.csv", ["ends in .csv", "expected .json"]),
        ("slam log -o log/frames.parquet", ["is a file of the log log"]),
        ("slam log -o sub/../log/observations.csv", ["is a file of the log log"]),
        ("slam log -o m.json", ["ends in .json", ".parquet or .csv"]),
        ("check quick --junit r.csv", ["--junit r.csv", "expected .xml"]),
        ("check quick -o r.csv", ["expected .json"]),
        ("report log -o r.parquet", ["expected .html"]),
        ("import mrclam log -o log", ["is an input"]),
        ("import euroc log -o .", ["holds the input log"]),
        ("study calibrate log -o log", ["is an input"]),
        ("export log --format tum -o log", ["is an input"]),
        ("export log --format tum -o a.csv", ["a.csv: ends in .csv, as a file does"]),
        ("record quick -o logs.parquet", ["ends in .parquet", "writes a folder"]),
        ("statistics log -o log", ["is an input"]),
        ("compare log log -o log", ["is an input"]),
        ("sweep quick -o a.csv", ["a.csv: ends in .csv, as a file does"]),
        ("run quick -o .", ["holds other files than a result's"]),
        ("study refusal log -o log", ["is an input"]),
        ("study benchmark -o a.csv", ["a.csv: ends in .csv, as a file does"]),
        ("study independence quick -o a.csv", ["a.csv: ends in .csv, as a file does"]),
    ],
)
def test_every_command_refuses_what_would_do_harm(
    maps: list[Path],
    arguments: str,
    said: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(maps[0].parent)
    Path("log").mkdir()
    Path("sub").mkdir()
    Path("log/frames.csv").write_text("iteration\n")
    before = contents(Path())
    assert_refused(command(capsys, *arguments.split()), *said)
    assert contents(Path()) == before


def test_what_belongs_to_an_input_is_no_output_either(tmp_path: Path) -> None:
    """The files beside a map, and the second of several fused maps."""
    for name in ("a.parquet", "a.joint.parquet", "f.2.parquet"):
        (tmp_path / name).write_text("there")
    a, second = tmp_path / "a.parquet", tmp_path / "f.2.parquet"
    with pytest.raises(InputError, match="is an input"):
        require_map_file(a, [a])
    with pytest.raises(InputError, match=r"is an input"):
        require_map_file(tmp_path / "a.joint.parquet", [tmp_path / "a.joint.parquet"])
    with pytest.raises(InputError, match=r"a\.joint\.parquet would replace"):
        require_map_file(a.with_suffix(".PARQUET"), [a])
    require_map_file(tmp_path / "a.csv", [a])  # stands alone
    require_map_file(tmp_path / "f.parquet", [second], n_maps=1)
    with pytest.raises(InputError, match=r"f\.2\.parquet would replace the input"):
        require_map_file(tmp_path / "f.parquet", [second], n_maps=2)
    require_folder(tmp_path / "new.folder", [a])
    (tmp_path / "file").write_text("there")
    with pytest.raises(InputError, match="is a file"):
        require_folder(tmp_path / "file")
    require_folder(tmp_path, [a])  # a file in it stays
    with pytest.raises(InputError, match="cannot be written"):
        require_folder(a / "below")


def test_a_merged_csv_is_read_back_as_it_is(
    maps: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = maps[0].parent
    for name in ("f.csv", "f.parquet"):
        assert command(capsys, "merge", *maps[:2], *ONE, "-o", folder / name).code == 0
    csv, parquet = (read_map(folder / name) for name in ("f.csv", "f.parquet"))
    for name in ("position_m", "covariance_m2", "count", "source_observation", "label"):
        np.testing.assert_array_equal(getattr(csv, name), getattr(parquet, name))
    assert parquet.joint is not None
    assert csv.joint is None
    said = command(capsys, "merge", *maps[:2], *ONE, "-o", folder / "f.csv").complaints
    assert "f.csv: CSV cannot hold the map's joint covariance; .parquet keeps all" in said[0]
    assert read_map(folder / "f.parquet").joint is not None  # which a CSV beside it left alone
    assert command(capsys, "align", folder / "f.csv", maps[1], *ONE).code == 0


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("n", [0, 1, 5])
def test_maps_of_all_kinds_go_through_csv(tmp_path: Path, planar: bool, n: int) -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(n, 3, 3))
    look = (rng.normal(size=(n, 64)) * 10.0 ** rng.integers(-9, 9, (n, 64))).astype(np.float32)
    look[1:2] = np.nan
    written = LandmarkMap(
        rng.normal(size=(n, 3)) * [1, 1, not planar],
        root @ np.swapaxes(root, 1, 2),
        rng.integers(1, 9, n).astype(np.int32),
        rng.integers(0, 99, n).astype(np.int64),
        look,
        None if planar else rng.integers(0, 9, n).astype(np.int32),
        planar,
    )
    write_map(tmp_path / "m.csv", written)
    read = read_map(tmp_path / "m.csv")
    assert (read.planar, read.name) == (planar, "m")
    size = 2 if planar else 3
    S, S_read = (m.covariance_m2[:, :size, :size] for m in (written, read))
    np.testing.assert_array_equal(S_read, S)
    np.testing.assert_array_equal(read.position_m, written.position_m)
    for name in ("count", "source_observation", "descriptor", "label") if n else ():
        np.testing.assert_equal(getattr(read, name), getattr(written, name))


def test_a_merge_of_nothing_writes_nothing_and_tells_why(
    maps: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    output = maps[0].parent / "f.parquet"
    output.write_text("of an earlier day")
    before = contents(maps[0].parent)
    reply = command(capsys, "merge", maps[0], maps[2], *ONE, "-o", output)
    assert reply.code == 1
    names = [read_map(path).name for path in (maps[0], maps[2])]
    assert f"No two maps were merged. {names[0]} and {names[1]}: svd: refused: " in reply.out
    assert reply.out.count("20 labels are in both maps") == 1
    assert reply.complaints == [f"mapfusion: no two maps were merged; {output} is not written"]
    assert contents(maps[0].parent) == before
    reply = command(capsys, "merge", maps[0], maps[2], *ONE, "-o", output, "--json")
    assert reply.code == 1
    assert '"map": null' in reply.out
    assert '"merged": false' in reply.out
    assert contents(maps[0].parent) == before


def test_maps_that_cannot_all_be_written_leave_the_earlier_ones(
    tmp_path: Path,
) -> None:
    """A full disk at the last of a map's files: the map of before is there, with all its files."""
    rng = np.random.default_rng(0)
    old, new = (landmark_map(rng.uniform(0, 9, (6, 3))) for _ in range(2))
    joint = JointCovariance(0.5 * old.covariance_m2, 0.1 * rng.normal(size=(6, 2, 3)))
    old = replace(old, joint=joint, covariance_m2=joint.marginal_m2)
    path = tmp_path / "m.parquet"
    write_map(path, old)
    before = contents(tmp_path)
    assert {each.name for each in before} == {"m.parquet", "m.joint.parquet"}
    (tmp_path / "m.frames.parquet").mkdir()  # where no file can be
    with pytest.raises(OSError, match="directory"):
        write_map(path, new)
    (tmp_path / "m.frames.parquet").rmdir()
    assert contents(tmp_path) == before


def test_a_terminal_that_lacks_characters_gets_others(
    maps: list[Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tables with dashes, paths and complaints with umlauts."""
    folder = maps[0].parent / "fü–"
    folder.mkdir()
    a, b = (Path(shutil.copy(path, folder)) for path in maps[:2])
    for encoding in ("iso-8859-1", "ascii"):
        streams = [io.TextIOWrapper(io.BytesIO(), encoding) for _ in range(2)]
        monkeypatch.setattr(sys, "stdout", streams[0])
        monkeypatch.setattr(sys, "stderr", streams[1])
        merged = command(capsys, "merge", a, b, *ONE, "-o", folder / "f.csv")
        aligned = command(capsys, "align", a, maps[2], *ONE)
        wrong = command(capsys, "align", a, folder / "nö.csv")
        assert (merged.code, aligned.code, wrong.code) == (0, 0, 2)
        for stream, words in zip(streams, (b"20 landmarks in ", b"no such file"), strict=True):
            stream.flush()
            written = stream.buffer.getvalue()
            assert words in written
            assert written.decode(encoding)


def test_a_c_locale_reads_and_writes_files_of_any_name(maps: list[Path]) -> None:
    """The names of maps that have none of their own are those of their files."""
    folder = maps[0].parent / "fü"
    folder.mkdir()
    code = (
        "import sys; from pathlib import Path; from mapfusion.landmark_map import *; "
        "m = read_map(Path(sys.argv[1])); write_map(Path(sys.argv[2]), m)"
    )
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    given = {**os.environ, "PYTHONPATH": str(ROOT), **locale}
    a, written = Path(shutil.copy(maps[0], folder / "ä.csv")), folder / "ö.parquet"
    subprocess.run([sys.executable, "-c", code, a, written], env=given, check=True)
    assert read_map(written).name == "ä"
