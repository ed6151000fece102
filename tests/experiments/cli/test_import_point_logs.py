"""The worked example of the page on logs of points and ranges, from tables to a map."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry import se2
from mapfusion.landmark_map import read_map
from tests.helpers.tiny_scenario import command
from tests.mapfusion.datasets.test_point_logs import write_recording

PAGE = Path(__file__).parents[3] / "docs" / "point_logs.md"
FROM_DEGREES, EXAMPLE = re.findall(
    r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
)


def test_the_worked_example_maps_the_trees(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, np.ndarray] = {}
    exec(EXAMPLE, names)
    page = PAGE.read_text(encoding="utf-8").splitlines()
    lines = [line for line in page if line.startswith("mapfusion ")]
    imported, mapped = (command(capsys, *shlex.split(line)[1:]) for line in lines)
    assert (imported.code, mapped.code) == (0, 0)
    assert "60 frames" in imported.out
    assert "associated by gate" in imported.out
    assert "no descriptor: they are associated by gate" in mapped.err
    landmarks = read_map(Path("orchard.smoothed.parquet"))
    trees = np.column_stack([names["trees"], np.zeros(8)])
    # The map begins at the first pose: at (2, 0), with the heading of the y axis.
    world = se2.transform_points(np.array([2.0, 0.0, np.pi / 2]), landmarks.position_m)
    nearest = np.argmin(np.linalg.norm(world[:, None] - trees, axis=2), axis=1)
    assert sorted(nearest) == list(range(8))
    T = np.array(fit_rigid(trees[nearest], world, np.arange(8)))
    apart = se2.transform_points(T, world) - trees[nearest]
    # Some forty sightings of 0.05 m each leave about a centimetre.
    assert np.sqrt(np.mean(np.sum(apart**2, axis=1))) < 0.03
    assert np.hypot(*T[:2]) < 0.1


@pytest.mark.parametrize(
    ("column", "change", "said"),
    [
        ("range_m", lambda r: 1000 * r, "are the observed ones millimetres?"),
        ("bearing_rad", lambda b: -b, "the heading has the other sign"),
        ("bearing_rad", lambda b: np.mod(np.pi / 2 - b, 2 * np.pi), "y points ahead"),
    ],
    ids=["millimetres", "mirrored", "exchanged axes"],
)
def test_mistakes_in_ranges_without_labels_are_told(
    column: str,
    change: Callable[[pd.Series], pd.Series],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(EXAMPLE, {})
    table = pd.read_csv("orchard/ranges.csv")
    table.assign(**{column: change(table[column])}).to_csv("orchard/ranges.csv", index=False)
    noise = ("--param", "range_sigma_m=0.05", "--param", "bearing_sigma_rad=0.01")
    told = command(capsys, "import", "ranges", "orchard", "-o", "logs", *noise)
    assert told.code == 1
    assert said in told.err


def test_the_conversion_from_degrees(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(EXAMPLE, {})
    monkeypatch.chdir("orchard")
    tables = {
        column: (f"{name}.csv", pd.read_csv(f"{name}.csv"))
        for name, column in [("odometry", "turn_rate_rad_s"), ("ranges", "bearing_rad")]
    }
    for column, (file, table) in tables.items():
        table.assign(**{column: np.degrees(table[column])}).to_csv(file, index=False)
    exec(FROM_DEGREES, {})
    for file, table in tables.values():
        pd.testing.assert_frame_equal(pd.read_csv(file), table)


@pytest.mark.parametrize(
    ("table", "said", "code"),
    [
        ("odometry", "the odometry contradicts the motion that the observations show", 1),
        ("truth_poses", "the truth contradicts the odometry", 0),
    ],
)
def test_import_compares_odometry_truth_and_observations(
    table: str, said: str, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "R1", {}, "points")
    call = ("import", "points", tmp_path / "R1", "-o", tmp_path / "logs", "--param", "sigma_m=0.05")
    sound = command(capsys, *call)
    assert sound.code == 0
    assert "contradict" not in sound.err
    path = tmp_path / "R1" / f"{table}.csv"
    poses = pd.read_csv(path)
    in_mm = poses.assign(x_m=1000 * poses["x_m"], y_m=1000 * poses["y_m"])
    in_mm.to_csv(path, index=False)
    wrong = command(capsys, *call)
    assert wrong.code == code
    assert f"warning: R1: {said}" in wrong.err
    assert "millimetres" in wrong.err
    assert ("odometry and observations contradict each other" in wrong.err) == bool(code)


def test_a_log_with_one_observation_a_frame_is_said_to_be_unchecked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "R1", {}, "points")
    path = tmp_path / "R1" / "points.csv"
    call = ("import", "points", tmp_path / "R1", "-o", tmp_path / "logs", "--param", "sigma_m=0.05")
    assert "not checked" not in command(capsys, *call).err
    pd.read_csv(path).drop_duplicates("time_s").to_csv(path, index=False)
    said = "the odometry is not checked: 0 of 40 frames show 2 points or more, and 0 share"
    told = command(capsys, *call)
    assert told.code == 0
    assert f"warning: R1: {said}" in told.err
    mapped = command(capsys, "slam", tmp_path / "logs" / "R1", "-o", tmp_path / "m.parquet")
    assert f"{said} as many with the frame before; the filter uses the noise of" in mapped.err
