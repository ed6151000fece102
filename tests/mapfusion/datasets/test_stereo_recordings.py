"""Four layouts of one rendered drive give the same log."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapfusion.datasets.formats import import_recording, read_recording, settings_class
from mapfusion.datasets.levelling import MountSettings
from mapfusion.datasets.stereo_import import Imported, RecordingPart, StereoImport
from mapfusion.datasets.stereo_recording import Shot, pair_shots
from mapfusion.errors import InputError, TellingWarning
from mapfusion.geometry import se2, se3
from mapfusion.robot_log import read_log
from mapfusion.vision.front_end import FrontEndParameters
from tests.mapfusion.datasets.written_layouts import (
    CAMERA,
    POSES,
    START_NS,
    TIMES_S,
    WRITERS,
    Pair,
    drive,
    read_yaml,
    write_calibration,
    write_euroc,
    write_images,
    write_kitti,
)


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    return drive()


@pytest.fixture(scope="module")
def folders(pairs: list[Pair], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return layouts that tests only read."""
    return {name: write(tmp_path_factory.mktemp(name), pairs) for name, write in WRITERS.items()}


def read(name: str, folder: Path, **mount: float) -> Any:
    settings = settings_class(name)(mount=MountSettings(**mount))
    return read_recording(name, folder, settings, read_yaml)


def imported(name: str, folder: Path, rows: slice = slice(None), **mount: float) -> Imported:
    return StereoImport(read(name, folder, **mount)).log_of(RecordingPart("R1", rows))


@pytest.fixture(scope="module")
def logs(folders: dict[str, Path]) -> dict[str, Imported]:
    low = {"z_m": 0.45}
    own = {"kitti": low, "kitti_raw": low, "euroc": {}, "images": low}
    return {name: imported(name, folder, **own[name]) for name, folder in folders.items()}


@pytest.mark.parametrize("name", list(WRITERS))
def test_pictures_and_times_come_as_they_were_written(
    name: str, folders: dict[str, Path], pairs: list[Pair]
) -> None:
    recording = read(name, folders[name])
    assert len(recording) == len(pairs)
    for k, (time_s, *found) in enumerate(recording):
        assert time_s == pytest.approx(TIMES_S[k], abs=1e-9)
        for image, written in zip(found, pairs[k], strict=True):
            np.testing.assert_array_equal(image, written)


@pytest.mark.parametrize("name", list(WRITERS))
def test_odometry_and_truth_are_those_of_the_drive(name: str, logs: dict[str, Imported]) -> None:
    log, truth = logs[name].log, logs[name].truth
    assert truth is not None
    np.testing.assert_allclose(log.odometry[1:], se2.between(POSES[:-1], POSES[1:]), atol=1e-12)
    np.testing.assert_allclose(
        se2.between(truth[0], truth), se2.between(POSES[0], POSES), atol=1e-9
    )
    np.testing.assert_allclose(log.time_s, TIMES_S, atol=1e-9)


@pytest.mark.parametrize("name", list(WRITERS))
def test_observations_lie_on_the_walls(name: str, logs: dict[str, Imported]) -> None:
    log = logs[name].log
    seen = log.observations
    assert len(seen) > 60
    p_world = np.concatenate(
        [
            se2.transform_points(POSES[k], seen.position_m[log.iteration == k])
            for k in range(len(log))
        ]
    )
    walls = np.stack([p_world[:, 0] - 3, p_world[:, 1] - 1.5, p_world[:, 1] + 1.5], -1)
    assert np.median(np.abs(walls).min(axis=1)) < 0.02


def test_the_truth_of_a_colour_pair_is_of_a_robot_that_carries_it(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    """The colour pair and its robot are 0.06 m to the left of the grey pair."""
    day = Path(shutil.copytree(folders["kitti_raw"].parent, tmp_path / "day"))
    drive, aside_m = day / folders["kitti_raw"].name, 0.06
    for grey, colour in ((0, 2), (1, 3)):
        (drive / f"image_0{grey}").rename(drive / f"image_0{colour}")
    f, (cu, cv) = CAMERA.focal_px, CAMERA.center_px
    calibration = day / "calib_cam_to_cam.txt"
    rows = [calibration.read_text(encoding="utf-8").rstrip("\n")]
    for k in (0, 1):
        beside_px = f * (aside_m - k * CAMERA.baseline_m)
        rows.append(f"S_rect_0{k + 2}: {CAMERA.width_px} {CAMERA.height_px}")
        rows.append(f"P_rect_0{k + 2}: {f} 0 {cu} {beside_px} 0 {f} {cv} 0 0 0 1 0")
    calibration.write_text("\n".join([*rows, ""]), encoding="utf-8")
    settings = settings_class("kitti_raw")(cameras="colour", mount=MountSettings(z_m=0.45))
    found = read_recording("kitti_raw", drive, settings, read_yaml).truth
    assert found is not None
    carried = se2.compose(POSES, np.array([0.0, aside_m, 0.0]))
    T = se3.planar(found.T)
    np.testing.assert_allclose(se2.between(T[0], T), se2.between(carried[0], carried), atol=1e-9)


def test_one_drive_in_four_layouts_is_one_log(logs: dict[str, Imported]) -> None:
    first = logs["kitti"].log.observations
    for name in ("kitti_raw", "euroc", "images"):
        other = logs[name].log.observations
        np.testing.assert_allclose(other.position_m, first.position_m, atol=1e-9)
        np.testing.assert_allclose(other.covariance_m2, first.covariance_m2, atol=1e-9)
        np.testing.assert_array_equal(other.descriptor, first.descriptor)


def test_a_cut_begins_anew_and_keeps_the_clock(folders: dict[str, Path]) -> None:
    cut = imported("kitti", folders["kitti"], slice(1, 5))
    np.testing.assert_allclose(cut.log.time_s, TIMES_S[1:])
    assert np.all(cut.log.odometry[0] == 0)
    assert cut.truth is not None
    np.testing.assert_allclose(
        se2.between(cut.truth[0], cut.truth), se2.between(POSES[1], POSES[1:]), atol=1e-9
    )
    assert cut.observations[:2].tolist() == [0, 0]  # no track has lasted yet
    assert cut.observations[2] > 0
    other = imported("kitti", folders["kitti"], slice(0, None, 2))
    two = se2.between(POSES[0], POSES[2])
    np.testing.assert_allclose(other.log.odometry[1], two, atol=1e-12)


def test_a_tilted_mount_turns_the_points_back(folders: dict[str, Path]) -> None:
    level = imported("kitti", folders["kitti"]).log.observations
    tilted = imported("kitti", folders["kitti"], pitch_rad=0.2, z_m=2.0).log.observations
    cos, sin = np.cos(0.2), np.sin(0.2)  # looking down: what lies ahead is lower
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    left = np.array([0, CAMERA.baseline_m / 2, 1.65])
    moved = (level.position_m - left) @ turn.T + left + [0, 0, 0.35]
    np.testing.assert_allclose(tilted.position_m, moved, atol=1e-12)
    np.testing.assert_allclose(
        tilted.covariance_m2, turn @ level.covariance_m2 @ turn.T, atol=1e-12
    )


def test_sixteen_bits_and_colour_are_the_same_pictures(
    pairs: list[Pair], folders: dict[str, Path], tmp_path: Path
) -> None:
    """Ten bits in 16 are shifted by two; grey in three channels is unchanged."""
    deep = [tuple(4 * image.astype(np.uint16) for image in pair) for pair in pairs]
    coloured = [tuple(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in pair) for pair in pairs]
    for name, written in (("deep", deep), ("coloured", coloured)):
        recording = read("kitti", write_kitti(tmp_path / name, written))
        for k, (left, right) in enumerate(pairs):
            found = recording.pair(k)
            np.testing.assert_array_equal(found[0], left)
            np.testing.assert_array_equal(found[1], right)


def test_missing_pictures_are_named_and_left_out(pairs: list[Pair], tmp_path: Path) -> None:
    folder = write_euroc(tmp_path, pairs)
    stamp = START_NS + 200_000_000
    (folder / "mav0" / "cam1" / "data" / f"{stamp}.png").unlink()
    recording = read("euroc", folder)
    assert len(recording) == len(pairs) - 1
    first, second = recording.dropped
    assert first == f"cam1/data/{stamp}.png (no such file)"
    assert second.startswith(f"cam0/data/{stamp}.png (no partner")


def test_pairs_are_each_others_nearest_in_time() -> None:
    def shots(*times_ms: float) -> list[Shot]:
        return [Shot(round(1e6 * t), f"{t}", lambda: np.zeros((1, 1))) for t in times_ms]

    left, right = shots(0, 50, 100, 150, 200, 300, 301.5), shots(1, 51, 99, 101, 149, 260, 301)
    times, pictures, dropped = pair_shots(Path("drive"), left, right)
    assert (times / 1e6).tolist() == [0, 50, 100, 150, 301.5]
    assert len(pictures) == 5
    assert [text.split(" (")[0] for text in dropped] == ["200", "300", "101", "260"]
    with pytest.raises(InputError, match="make 1 pairs"):
        pair_shots(Path("drive"), shots(0, 50), shots(0, 90))


def test_clocks_that_differ_by_a_constant_are_told() -> None:
    def shots(*times_ms: float) -> list[Shot]:
        return [Shot(round(1e6 * t), f"{t}", lambda: np.zeros((1, 1))) for t in times_ms]

    left, right = shots(*range(0, 500, 50)), shots(*range(150, 650, 50))
    for shifted in ((left, right), (right, left)):
        with pytest.warns(TellingWarning, match="the first 3 pictures of .* and the last 3 of"):
            pair_shots(Path("drive"), *shifted)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pair_shots(Path("drive"), left, shots(*range(150, 450, 50)))  # a shorter recording
        pair_shots(Path("drive"), left, shots(*range(50, 550, 50)))  # one picture late


def test_a_list_of_pairs_stands_for_folders(pairs: list[Pair], tmp_path: Path) -> None:
    folder = write_images(tmp_path, pairs)
    names = sorted(path.name for path in (folder / "left").iterdir())
    lines = [f"{t},left/{n},right/{n}" for t, n in zip(TIMES_S, names, strict=True)]
    (folder / "pairs.csv").write_text("# time_s, left, right\n" + "\n".join(lines[1:]) + "\n")
    recording = read("images", folder)
    assert len(recording) == len(pairs) - 1
    np.testing.assert_array_equal(recording.pair(0)[1], pairs[1][1])


def test_pictures_alone_tell_the_way(pairs: list[Pair], tmp_path: Path) -> None:
    """The pause is a step of twice the length."""
    sequence = write_kitti(tmp_path, pairs)
    (sequence / "odometry.tum").unlink()
    seen = imported("kitti", sequence)
    true = se2.between(POSES[:-1], POSES[1:])
    assert seen.guessed == 0
    assert seen.odometry_covariance is not None
    errors = seen.log.odometry[1:] - true
    assert np.abs(errors[:, :2]).max() < 0.02
    assert np.abs(errors[:, 2]).max() < 0.005
    squares = [
        e @ np.linalg.solve(S, e) for e, S in zip(errors, seen.odometry_covariance[1:], strict=True)
    ]
    assert np.mean(squares) / 3 < 3


def test_a_recording_is_written_as_a_log(folders: dict[str, Path], tmp_path: Path) -> None:
    (path,) = import_recording("kitti", folders["kitti"], tmp_path)
    assert path.name == "07"
    assert len(read_log(path)) == len(POSES)


def test_truth_does_not_reach_the_log(pairs: list[Pair], tmp_path: Path) -> None:
    sequence = write_kitti(tmp_path, pairs)
    first = imported("kitti", sequence).log
    (tmp_path / "poses" / "07.txt").unlink()
    second = imported("kitti", sequence)
    assert second.truth is None
    np.testing.assert_array_equal(first.observations.position_m, second.log.observations.position_m)
    np.testing.assert_array_equal(first.odometry, second.log.odometry)


def test_a_pair_that_is_not_rectified_is_refused(pairs: list[Pair], tmp_path: Path) -> None:
    lower = [(left, np.roll(right, 4, axis=0)) for left, right in pairs]
    with pytest.raises(InputError, match=r"4\.\d rows apart.*not rectified"):
        imported("kitti", write_kitti(tmp_path, lower))


def test_front_end_settings_can_be_replaced(folders: dict[str, Path]) -> None:
    def fewer(derived: FrontEndParameters) -> FrontEndParameters:
        return replace(derived, harris=replace(derived.harris, max_corners=20))

    work = StereoImport(read("kitti", folders["kitti"]), fewer)
    assert work.log_of(RecordingPart("R1", slice(None))).observations.max() <= 20


def test_pictures_go_with_the_times_in_their_names(tmp_path: Path) -> None:
    """10.0.png precedes 9.5.png by name; a unique grey level identifies each picture."""
    seconds, size = ("9.0", "9.5", "10.0", "10.5"), (CAMERA.height_px, CAMERA.width_px)
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for level, name in enumerate(seconds):
            cv2.imwrite(str(tmp_path / side / f"{name}.png"), np.full(size, 40 + level, np.uint8))
    write_calibration(tmp_path / "calibration.yaml")
    recording = read("images", tmp_path)
    np.testing.assert_array_equal(recording.time_ns, [int(1e9 * float(s)) for s in seconds])
    levels = [int(left[0, 0]) for _, left, _ in recording]
    assert levels == [40, 41, 42, 43]
