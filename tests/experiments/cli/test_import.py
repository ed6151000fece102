"""The settings of an importer, given on the command line."""

from pathlib import Path

import pytest

from mapfusion.robot_log import read_log
from tests.helpers.tiny_scenario import assert_refused, command


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("range_sigma=1", ["mrclam: range_sigma: unknown key", "range_sigma_m"]),
        ("range_sigma_m=-1", ["mrclam", "range_sigma_m", "finite and positive"]),
        ("frame_s=soon", ["mrclam: frame_s", "number"]),
    ],
)
def test_wrong_settings_are_one_line(
    setting: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(
        capsys, "import", "mrclam", tmp_path, "-o", tmp_path / "logs", "--param", setting
    )
    assert_refused(reply, *words)


def test_settings_reach_the_importer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "recording"
    folder.mkdir()
    (folder / "Barcodes.dat").write_text("6 72\n")
    (folder / "Robot1_Odometry.dat").write_text("0 0.1 0\n4 0.1 0\n")
    (folder / "Robot1_Measurement.dat").write_text("1 72 2.0 0.0\n")
    logs = tmp_path / "logs"
    given = ("--param", "range_sigma_m=0.3", "--param", "range_sigma_ratio=0")
    assert command(capsys, "import", "mrclam", folder, "-o", logs, *given).code == 0
    log = read_log(logs / "robot1")
    assert log.observations.covariance_m2[0, 0, 0] == pytest.approx(0.3**2)
    assert not (logs / "robot1" / "truth_poses.parquet").exists()


@pytest.mark.parametrize(
    ("format_name", "words"),
    [("rosbag", ["--calibration pair.yaml: no such file"]), ("kitti", ["has files of its own"])],
)
def test_a_calibration_file_is_for_formats_that_take_one(
    format_name: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("--calibration", "pair.yaml")
    reply = command(capsys, "import", format_name, tmp_path, "-o", tmp_path / "logs", *given)
    assert_refused(reply, *words)
