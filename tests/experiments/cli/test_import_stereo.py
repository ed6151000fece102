"""Importing stereo pictures on the command line: robots by frames, the summary, exit codes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapfusion.attitude import read_attitude
from mapfusion.camera import CalibrationError
from mapfusion.robot_log import read_log
from tests.helpers.tiny_scenario import assert_refused, command
from tests.mapfusion.datasets.written_layouts import POSES, drive, tum_lines, write_kitti


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_kitti(tmp_path_factory.mktemp("kitti"), drive())


def test_frames_cut_a_recording_into_robots(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = ("--frames", "A=0:3", "--frames", "1:", "--vision", "tracks.min_length=2")
    reply = command(capsys, "import", "kitti", sequence, "-o", tmp_path, *own)
    assert reply.code == 0, reply.err
    assert {path.name for path in tmp_path.iterdir()} == {"A", "07-2"}
    assert len(read_log(tmp_path / "A")) == 3
    assert len(read_log(tmp_path / "07-2")) == 4
    for words in ("07: 5 pairs", "240x180 px", "A ", "07-2", "3 frames", str(tmp_path / "A")):
        assert words in reply.out


def test_several_recordings_and_processes_change_nothing(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two recordings by two processes; each alone, and in this process, is the same."""
    copy = write_kitti(tmp_path / "second", drive()).rename(tmp_path / "second" / "other")
    own = ("--vision", "tracks.min_length=2", "--odometry", "images")
    both = ("import", "kitti", sequence, copy, "-o", tmp_path / "both", "--jobs", 2)
    reply = command(capsys, *both, *own)
    assert reply.code == 0, reply.err
    for path, name in ((sequence, "07"), (copy, "other")):
        alone = ("import", "kitti", path, "-o", tmp_path / "alone", "--jobs", 1)
        assert command(capsys, *alone, *own).code == 0
        assert f"{name}: 5 pairs" in reply.out
        logs = [read_log(tmp_path / folder / name) for folder in ("both", "alone")]
        for field in ("position_m", "covariance_m2", "descriptor", "track"):
            first, second = (getattr(log.observations, field) for log in logs)
            np.testing.assert_array_equal(first, second)
        np.testing.assert_array_equal(logs[0].odometry, logs[1].odometry)


def test_of_several_recordings_none_is_written_where_one_is_refused(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = tmp_path / "logs"
    refused = {
        ("two robots are named 07", "--frames"): (sequence, sequence),
        ("nothing", "no such file"): (sequence, tmp_path / "nothing"),
        ("--odometry and --truth", "one"): (sequence, sequence, "--truth", tmp_path / "t.tum"),
    }
    for words, given in refused.items():
        reply = command(capsys, "import", "kitti", *given, "-o", logs)
        assert_refused(reply, *words)
        assert not logs.exists()


@pytest.mark.parametrize(
    ("given", "left_open"),
    [
        ((), lambda usual: usual.scale > 0 and usual.heading_rad > 0.002),
        (("heading_rad=0.01",), lambda own: own.heading_rad == 0.01 and own.scale > 0),
        (("heading_rad=0", "scale=0"), lambda own: own.is_none),
        (("camera=both robots'",), lambda own: own.camera == "both robots'" and own.scale > 0),
    ],
)
def test_what_calibration_leaves_open_goes_with_the_log(
    given: tuple[str, ...],
    left_open: Callable[[CalibrationError], bool],
    sequence: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    own = [word for each in given for word in ("--calibration", each)]
    own += ["--vision", "tracks.min_length=2"]
    assert command(capsys, "import", "kitti", sequence, "-o", tmp_path, *own).code == 0
    assert left_open(read_log(tmp_path / "07").calibration)


@pytest.mark.parametrize("level", ["pictures", "floor"])
def test_attitude_stands_beside_a_log_that_is_levelled_by_it(
    level: str, sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = ("--level", level, "--vision", "tracks.min_length=2")
    assert command(capsys, "import", "kitti", sequence, "-o", tmp_path, *own).code == 0
    attitude = read_attitude(tmp_path / "07")
    assert attitude is not None
    assert np.abs(attitude.value).max() < 0.05  # the drive is level
    shown = command(capsys, "inspect", tmp_path / "07" / "attitude.parquet")
    assert shown.code == 0
    assert "pitch_rad" in shown.out


def test_too_little_to_map_is_exit_code_1(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ("--vision", "harris.max_corners=2")
    reply = command(capsys, "import", "kitti", sequence, "-o", tmp_path, *few)
    assert reply.code == 1
    assert reply.complaints[-1].startswith("mapfusion: 07: too little to map: ")
    assert len(reply.complaints) == 1


def test_trajectories_are_taken_from_files(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "turned.tum"
    path.write_text(tum_lines(0, POSES * [1, 1, -1]))
    logs = tmp_path / "logs"
    given = ("--odometry", path, "--truth", path, "--vision", "tracks.min_length=1")
    assert command(capsys, "import", "kitti", sequence, "-o", logs, *given).code == 0
    turned = read_log(logs / "07").odometry[:, 2]
    np.testing.assert_allclose(turned[1:], -np.diff(POSES[:, 2]), atol=1e-12)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("--frames", "3"), ["--frames 3", "FROM:TO"]),
        (("--frames", "0:4:0"), ["--frames 0:4:0"]),
        (("--frames", "a b=0:4"), ["--frames a b=0:4"]),
        (("--frames", "A=0:2", "--frames", "A=2:4"), ["two robots are named A"]),
        (("--frames", "4:"), ["07: frames of 07 are 1 of 5 pairs"]),
        (("--vision", "haris.k=1"), ["haris", "harris"]),
        (("--vision", "harris.k=1"), ["--vision: harris", "k"]),
        (("--param", "cameras=red"), ["kitti: cameras", "grey"]),
        (("--param", "mount.pitch_rad=3"), ["pitch_rad", "[-1.5, 1.5] rad"]),
        (("--odometry", "none.tum"), ["none.tum: no such file"]),
        (("--calibration", "scale=-1"), ["--calibration: scale", "[0, 1]"]),
        (("--level", "sideways"), ["--level", "mount"]),
        (("--level", "odometry", "--odometry", "images"), ["--level odometry", "no odometry"]),
    ],
)
def test_what_is_wrong_is_one_line(
    given: tuple[str, ...],
    words: list[str],
    sequence: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    reply = command(capsys, "import", "kitti", sequence, "-o", tmp_path / "logs", *given)
    assert_refused(reply, *words)
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [("%YAML:1.0\ncam2: 1\n", "cam0: is missing"), ("%YAML:1.0\n", "holds nothing"), ("[", "line")],
)
def test_a_calibration_that_is_none_is_one_line(
    text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "calibration.yaml").write_text(text)
    reply = command(capsys, "import", "images", tmp_path, "-o", tmp_path / "logs")
    assert_refused(reply, "calibration.yaml", words)


def test_a_robot_that_drove_blind_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The camera looks at nothing from the second frame on: what it does there no link tells."""
    pairs = drive()
    blind = [pairs[0], *((0 * left, 0 * right) for left, right in pairs[1:])]
    folder, own = write_kitti(tmp_path, blind), ("--odometry", "images")
    reply = command(capsys, "import", "kitti", folder, "-o", tmp_path / "o", *own)
    assert reply.code == 1
    assert f"07: guessed motions: {len(pairs) - 1}, its map may break there" in reply.out
