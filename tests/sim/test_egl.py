"""EGL's pictures are held to the same pinhole as TinyRenderer's, up to the filter on textures."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapfusion.errors import InputError
from sim import renderer
from sim.floorplan import FloorPlan
from sim.renderer import egl_driver
from sim.stereo_head import FAR_M, NEAR_M, StereoFrame, render_stereo
from sim.world import World
from tests.sim.ray_casting import CAMERA, NO_NOISE, POSE, off_surface_m, ray_cast

DEPTH_BITS = 16  # of the plug-in's depth buffer, found out below


def works() -> bool:
    try:
        egl_driver()
    except InputError:
        return False
    return True


needs_egl = pytest.mark.skipif(not works(), reason="this system has no EGL")


@pytest.fixture(scope="module")
def frame(faces: Path) -> StereoFrame:
    with World("egl") as world:
        world.add_painted_faces(faces)
        return render_stereo(world, CAMERA, POSE, NO_NOISE, np.random.default_rng(0))


def difference(
    room: FloorPlan, faces: Path, picture: np.ndarray, y_m: float, shift_px: tuple[float, float]
) -> float:
    """Mean square difference in gray levels from the picture ray cast with a shift."""
    cast = cv2.cvtColor(ray_cast(room, faces, y_m, shift_px), cv2.COLOR_RGB2GRAY)
    return float(np.mean((picture.astype(float) - cast) ** 2))


@needs_egl
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_picture_is_that_of_an_exact_pinhole_to_a_twentieth_of_a_pixel(
    room: FloorPlan, faces: Path, frame: StereoFrame, side: str, axis: int
) -> None:
    y_m = CAMERA.baseline_m / 2 * (1 if side == "left" else -1)
    errors = [
        difference(room, faces, getattr(frame, side), y_m, (s, 0) if axis == 0 else (0, s))
        for s in (-0.5, 0.0, 0.5)
    ]
    minus, here, plus = errors
    # lowest point of the parabola through the three
    shift_px = 0.5 * (minus - plus) / (2 * (minus - 2 * here + plus))
    assert abs(shift_px) < 0.05
    assert here < 0.6 * min(minus, plus)


@needs_egl
def test_textures_look_as_painted(faces: Path, frame: StereoFrame) -> None:
    with World() as world:
        world.add_painted_faces(faces)
        tiny = render_stereo(world, CAMERA, POSE, NO_NOISE, np.random.default_rng(0))
    picture = tiny.left_rgb
    around = np.ones((5, 5), np.uint8)
    flat = np.ptp([cv2.dilate(picture, around), cv2.erode(picture, around)], axis=0).max(-1) <= 2
    assert flat.mean() > 0.3
    off = frame.left_rgb[flat].astype(float) - picture[flat]
    assert abs(off.mean()) < 0.01
    assert np.mean(np.abs(off) <= 1) > 0.999
    assert np.abs(frame.left.astype(float) - tiny.left).mean() < 1.5


@needs_egl
def test_depth_is_right_to_the_steps_of_its_buffer(room: FloorPlan, frame: StereoFrame) -> None:
    off = off_surface_m(room, CAMERA, frame.depth_m)
    # d = f n / (f - (f - n) b): a step of the buffer is d^2 (1/n - 1/f) in depth
    step_m = frame.depth_m.ravel() ** 2 * (1 / NEAR_M - 1 / FAR_M) / 2**DEPTH_BITS
    assert np.all(off < step_m + 2e-4)


@needs_egl
def test_every_picture_is_the_same_whatever_was_drawn_before(
    faces: Path, frame: StereoFrame
) -> None:
    with World("egl") as world:
        world.add_painted_faces(faces)
        for pose in ([1.0, 1.0, 2.0], [4.0, 3.0, -2.0], POSE):
            again = render_stereo(world, CAMERA, pose, NO_NOISE, np.random.default_rng(0))
    np.testing.assert_array_equal(again.left, frame.left)
    np.testing.assert_array_equal(again.right, frame.right)
    np.testing.assert_array_equal(again.depth_m, frame.depth_m)


@needs_egl
def test_nothing_has_no_depth_and_nothing_is_said(capfd: pytest.CaptureFixture[str]) -> None:
    with World("egl") as world:
        empty = render_stereo(world, CAMERA, POSE, NO_NOISE, np.random.default_rng(0))
    assert np.all(np.isnan(empty.depth_m))
    assert capfd.readouterr() == ("", "")


@needs_egl
def test_a_world_left_open_ends_in_silence() -> None:
    code = "from sim.world import World; world = World('egl')"
    ended = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": os.getcwd()},
        capture_output=True,
        check=True,
    )
    assert (ended.stdout, ended.stderr) == (b"", b"")


def test_a_system_without_a_driver_is_told_in_one_line() -> None:
    """In a process of its own: the plug-in would end this one."""
    code = (
        "from sim.renderer import egl_driver\n"
        "from mapfusion.errors import InputError\n"
        "try: egl_driver()\n"
        "except InputError as error: print(error)\n"
    )
    nowhere = {"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent", "__EGL_VENDOR_LIBRARY_FILENAMES": ""}
    said = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | nowhere | {"PYTHONPATH": os.getcwd()},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    assert said.startswith("render.renderer: egl does not work here (")
    assert "libegl1" in said
    assert "\n" not in said


def test_a_missing_plug_in_is_told_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renderer, "PLUGIN", "no_such_plug_in")
    egl_driver.cache_clear()
    try:
        with pytest.raises(InputError, match="the plug-in is not installed"):
            World("egl")
    finally:
        egl_driver.cache_clear()
