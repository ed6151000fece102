"""Logs and recordings that contradict themselves: warnings, likely causes and exit codes."""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mapfusion.datasets.log_consistency import check_log
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import read_map
from mapfusion.robot_log import first_frames, read_log, write_log, write_truth_poses
from mapfusion.tables import HEIGHT
from tests.helpers.tiny_scenario import Reply, assert_refused, command
from tests.mapfusion.contradicting_logs import JUMPS, MISTAKES, circling_log, true_poses
from tests.mapfusion.datasets.written_layouts import (
    CAMERA,
    POSES,
    START_NS,
    drive,
    tum_lines,
    write_calibration,
    write_images,
)
from tests.mapfusion.noisy_odometry import NOISE, seen_log

OWN = ("--set", "slam.filter.association=label", "--set", "slam.filter.n_particles=20")
VISION = ("--vision", "tracks.min_length=1", "--jobs", 1)


def mapped(
    change: Callable[[Float], Float], tmp_path: Path, capsys: pytest.CaptureFixture[str], *more: str
) -> Reply:
    log = circling_log()
    write_log(tmp_path / "log", replace(log, odometry=change(log.odometry)))
    return command(capsys, "slam", tmp_path / "log", "-o", tmp_path / "m.parquet", *OWN, *more)


@pytest.mark.parametrize("name", ["absolute poses", "degrees", "millimetres"])
def test_a_map_that_its_log_contradicts_is_no_success(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, words = MISTAKES[name]
    reply = mapped(change, tmp_path, capsys)
    assert reply.code == 1
    warning, verdict = reply.complaints[-2:]
    assert warning.startswith(f"mapfusion: warning: {tmp_path / 'log'}: the odometry contradicts")
    assert all(word in warning for word in words)
    if name == "millimetres":
        assert "the map is empty: no landmark was seen often enough" in verdict
    else:
        assert "fell outside the gate" in verdict


def test_a_jump_is_named_and_the_map_is_right(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = mapped(JUMPS["3 m"][0], tmp_path, capsys, "--json")
    assert reply.code == 0
    (warning,) = [line for line in reply.complaints if "warning" in line]
    assert "frame 40: odometry moved 3.00 m, the observations" in warning
    (finding,) = json.loads(reply.out)["findings"]
    assert (finding["check"], finding["iteration"]) == ("jump", 40)
    jumped = read_map(tmp_path / "m.parquet").position_m
    assert mapped(np.array, tmp_path, capsys).code == 0
    np.testing.assert_allclose(jumped, read_map(tmp_path / "m.parquet").position_m, atol=0.1)


def test_truth_that_contradicts_a_log_is_told_by_slam(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "log").mkdir()
    write_truth_poses(tmp_path / "log", true_poses(60) * [1, 1, 180 / np.pi])
    reply = mapped(np.array, tmp_path, capsys)
    assert reply.code == 0
    assert "the truth contradicts the odometry" in reply.complaints[-1]
    assert "its heading looks like degrees" in reply.complaints[-1]
    before = (tmp_path / "m.parquet").read_bytes()
    write_truth_poses(tmp_path / "log", true_poses(60))
    assert not mapped(np.array, tmp_path, capsys).complaints
    assert (tmp_path / "m.parquet").read_bytes() == before  # the truth decides no number


def test_noisy_odometry_is_filtered_and_smoothed_with_its_own_noise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The maps are those of a scenario that states this noise."""
    log = seen_log(3.0, 3)
    write_log(tmp_path / "log", log)
    maps = [tmp_path / f"{name}.parquet" for name in ("log", "stated", "told")]
    motion = replace(NOISE, lateral_slip_m_per_rad=0.01)
    factor = check_log(log, motion).noise.factor
    own = [*OWN, "--set", "slam.filter.motion.scale_error=0"]
    own += ["--set", "slam.filter.motion.track_error=0"]
    larger = [
        argument
        for name, value in asdict(motion.scaled(factor)).items()
        for argument in ("--set", f"slam.filter.motion.{name}={value!r}")
    ]
    replies = [
        command(capsys, "slam", tmp_path / "log", "-o", path, *own, *more)
        for path, more in zip(maps, ([], ["--noise", "stated"], larger), strict=True)
    ]
    assert replies[0].code == replies[2].code == 0
    (used,), (kept,), none = (
        [line for line in reply.complaints if "times as noisy" in line] for reply in replies
    )
    for line in (used, kept):
        assert f"odometry is {factor:.1f} times as noisy as stated" in line
    assert "the filter uses the larger noise (slam.noise: stated" in used
    assert "the filter uses the stated noise (slam.noise: from_log" in kept
    assert not none
    for name in ("{}.parquet", "{}.smoothed.parquet"):
        ours, stated, told = (tmp_path / name.format(path.stem) for path in maps)
        assert ours.read_bytes() == told.read_bytes() != stated.read_bytes()


@pytest.mark.parametrize("n_frames", [3, 320])
def test_logs_whose_frames_share_no_points(
    n_frames: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The line about the noise comes once, unless the log is too short for any."""
    log = first_frames(seen_log(3.0, 3), n_frames)
    label = np.arange(len(log.observations), dtype=np.int32)
    write_log(tmp_path / "log", replace(log, observations=replace(log.observations, label=label)))
    reply = command(capsys, "slam", tmp_path / "log", "-o", tmp_path / "m.parquet", *OWN)
    said = [line for line in reply.complaints if "the odometry is not checked" in line]
    assert len(said) == (n_frames > 4)


def test_a_sound_log_is_mapped_without_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = mapped(np.array, tmp_path, capsys)
    assert (reply.code, [line for line in reply.complaints if "mapfusion" in line]) == (0, [])


def test_a_run_keeps_and_tells_what_logs_say_against_themselves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A jump of one robot, whose truth is in millimetres; the other, as CSV, has such odometry."""
    from experiments.evaluation import tables

    monkeypatch.setattr("experiments.reports.figures.drawing.FIGURES", ())  # drawn in other tests
    log = circling_log(30)
    jumped = replace(log, odometry=log.odometry + 3.0 * (np.arange(30)[:, None] == 20) * [1, 0, 0])
    write_log(tmp_path / "R1", jumped)
    wrong = replace(log, robot="R2", odometry=log.odometry * [1000, 1000, 1])
    write_log(tmp_path / "R2", wrong)
    for table in ("frames", "observations"):
        file = tmp_path / "R2" / f"{table}.parquet"
        rows = pd.read_parquet(file).drop(columns="descriptor", errors="ignore")
        rows.drop(columns=list(HEIGHT), errors="ignore").to_csv(
            file.with_suffix(".csv"), index=False
        )
        file.unlink()
    write_truth_poses(tmp_path / "R1", true_poses(30) * [1000, 1000, 1])
    text = "schema_version: 1\nname: two\nlogs: [R1, R2]\nevaluate: {every: 29}\n"
    text += "slam: {filter: {association: label, n_particles: 20}}\n"
    text += "align: {repetitions: 1, aligners: [{name: ransac, method: ransac}]}\n"
    (tmp_path / "two.yaml").write_text(text)
    path, results = tmp_path / "two.yaml", tmp_path / "results"
    reply = command(capsys, "run", path, "--jobs", 1, "--results", results)
    assert reply.code == 0
    said = "\n".join(reply.complaints)
    assert "R1: the truth contradicts the odometry in most frames" in said
    assert said.count("times those that are observed: millimetres?") == 2
    assert "warning: R1: frame 20: odometry moved 3." in said
    assert "warning: R2: the odometry contradicts" in said
    found = tables.read(tables.table_path(results / "two-0", "findings"), "findings")
    assert set(zip(found["robot"], found["check"], strict=True)) >= {
        ("R1", "jump"),
        ("R1", "truth"),
        ("R2", "odometry"),
    }
    assert command(capsys, "report", results / "two-0").code == 0
    assert "frame 20: odometry moved" in (results / "two-0" / "report.html").read_text()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_images(tmp_path_factory.mktemp("recorded"), drive())


def imported(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], **files: str
) -> Reply:
    folder = shutil.copytree(recording, tmp_path / "recording")
    for name, text in files.items():
        (folder / f"{name}.tum").write_text(text)
    return command(capsys, "import", "images", folder, "-o", tmp_path / "logs", *VISION)


def reordered(order: list[int], factor: float = 1.0) -> str:
    """The true trajectory with its columns in another order and positions times `factor`."""
    rows = []
    for line in tum_lines(START_NS, POSES).splitlines()[1:]:
        words = line.split()
        words[1:4] = [str(factor * float(word)) for word in words[1:4]]
        rows.append(" ".join(f"-{words[-k]}" if k < 0 else words[k] for k in order))
    return "\n".join(rows).replace("--", "") + "\n"


def test_sound_trajectories_are_taken_without_a_word(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tum_lines(START_NS, POSES)
    reply = imported(recording, tmp_path, capsys, odometry=own, truth=own)
    assert reply.code == 0
    assert "contradict" not in reply.err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (reordered([0, -2, -3, 1, -5, -6, 4, 7]), "axes are a camera's (z ahead, x right, y down)"),
        (reordered([*range(8)], 1000), "millimetres?"),
        (tum_lines(START_NS, POSES * [-1, -1, 1]), "x points back"),
    ],
)
def test_odometry_that_pictures_contradict_is_named(
    text: str, words: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = imported(recording, tmp_path, capsys, odometry=text)
    assert reply.code == 1
    warning, verdict = reply.complaints[-2:]
    assert "the odometry contradicts the motion that the pictures show" in warning
    assert words in warning
    assert "--odometry images" in verdict
    assert len(read_log(tmp_path / "logs" / "recording")) == len(POSES)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_focal_length_is_named(
    factor: float, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(recording, tmp_path / "recording")
    f = factor * CAMERA.focal_px
    write_calibration(folder / "calibration.yaml", intrinsics=[f, f, *CAMERA.center_px])
    (folder / "odometry.tum").write_text(tum_lines(START_NS, POSES))
    reply = command(capsys, "import", "images", folder, "-o", tmp_path / "logs", *VISION)
    assert reply.code == 1
    for what in ("odometry", "truth"):
        (warning,) = [line for line in reply.complaints if f"the {what} contradicts" in line]
        assert "focal length" in warning or "calibration" in warning


def test_truth_that_pictures_contradict_is_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = imported(recording, tmp_path, capsys, truth=reordered([0, 1, 2, 3, 7, 4, 5, 6]))
    assert reply.code == 0
    assert "the truth stands on end or on its head" in reply.complaints[-1]
    assert "w x y z in place of x y z w" in reply.complaints[-1]


def test_odometry_on_its_head_is_refused_by_its_line(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "# a comment\n" + reordered([0, 1, 2, 3, 7, 4, 5, 6])
    reply = imported(recording, tmp_path, capsys, odometry=text)
    assert_refused(reply, "odometry.tum, line 2", "on its head", "is the quaternion x y z w?")
    assert not (tmp_path / "logs").exists()


def test_truth_of_another_time_is_refused(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = imported(recording, tmp_path, capsys, truth=tum_lines(0, POSES))
    spans = ("the truth is of 0.000 to 1.000 s", f"{START_NS / 1e9:.3f} to")
    assert_refused(reply, *spans, "another clock")
