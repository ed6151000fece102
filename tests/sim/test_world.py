import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from sim.floorplan import FloorPlan, Wall
from sim.stereo_head import RadiometricNoise, render_stereo
from sim.world import World, silence, write_faces

EVERYTHING = """
import sys
from pathlib import Path
import numpy as np
from mapfusion.camera import StereoCamera
from sim.driver import DriverSettings, drive
from sim.floorplan import FloorPlan, Wall
from sim.rendering.frame_source import FrameSource
from sim.routes import Route
from sim.stereo_head import RadiometricNoise

square = np.array([[0, 0], [5, 0], [5, 4], [0, 4], [0, 0]])
plan = FloorPlan((Wall(square), Wall(np.array([[3, 0], [3, 1.5]]))))
routes = [Route("a", [1, 1, 0], [[2, 3]]), Route("b", [4, 1, 1], [[4, 3]])]
trajectory = drive(plan, routes, DriverSettings(), 5, 0.2)
noise = RadiometricNoise()
with FrameSource(Path(sys.argv[1]), StereoCamera(), "ab") as source:
    source.render(trajectory.T_world_robot[:, 4], "a", noise, np.random.default_rng(0))
"""


def test_nothing_reaches_the_screen(faces: Path) -> None:
    """PyBullet's C code prints past sys.stdout, so only another process can tell."""
    result = subprocess.run(
        [sys.executable, "-c", EVERYTHING, str(faces)], capture_output=True, check=True
    )
    assert result.stdout == b""
    assert result.stderr == b""


IMPORTS = """
import sys
from sim import driver, floorplan, odometry, routes, stereo_head, textures, trajectory
from sim.rendering import frame_source
assert "pybullet" not in sys.modules
"""


def test_pybullet_is_imported_by_what_simulates_alone() -> None:
    subprocess.run([sys.executable, "-c", IMPORTS], check=True)


def test_silence_lets_python_speak_before_and_after(capfd: pytest.CaptureFixture[str]) -> None:
    sys.stdout.write("before ")
    with silence():
        os.write(1, b"inside")
        os.write(2, b"inside")
    sys.stdout.write("after")
    sys.stderr.write("error")
    sys.stdout.flush()
    assert capfd.readouterr() == ("before after", "error")


C_PRINTS = """
import ctypes
from sim.world import silence
libc = ctypes.CDLL(None)
libc.printf(b"before ")
with silence():
    libc.printf(b"inside")
libc.printf(b"after")
"""


def test_what_c_still_buffers_is_sorted_too() -> None:
    buffered = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    result = subprocess.run(
        [sys.executable, "-c", C_PRINTS], capture_output=True, check=True, env=buffered
    )
    assert result.stdout == b"before after"


def test_silence_ends_with_an_error(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="broken"), silence():
        raise ValueError("broken")
    os.write(1, b"heard")
    assert capfd.readouterr().out == "heard"


def test_a_world_closes_once_and_again() -> None:
    with World() as world:
        assert world.bullet.getConnectionInfo(world.client)["isConnected"] == 1
    world.close()


def test_faces_are_the_same_for_the_same_seed(
    room: FloorPlan, texture_seed: int, faces: Path, tmp_path: Path
) -> None:
    write_faces(tmp_path, room, np.random.default_rng(texture_seed))
    names = sorted(path.name for path in faces.iterdir())
    assert len(names) == 2 * len(room.faces()) + 1
    assert names == sorted(path.name for path in tmp_path.iterdir())
    for name in names:
        assert (faces / name).read_bytes() == (tmp_path / name).read_bytes()


def test_a_mesh_written_anew_is_read_anew(tmp_path: Path) -> None:
    """PyBullet keeps meshes by file name; two worlds in one folder must not be mixed up."""
    depths = []
    for half in (2.0, 3.0):
        square = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        write_faces(tmp_path, FloorPlan((Wall(square),)), np.random.default_rng(0))
        with World() as world:
            world.add_painted_faces(tmp_path)
            camera = StereoCamera(64, 48, 57.7)
            frame = render_stereo(
                world, camera, np.zeros(3), RadiometricNoise(), np.random.default_rng(0)
            )
        depths.append(float(frame.depth_m[24, 32]))
    assert depths == pytest.approx([2 - 0.05 - 0.15, 3 - 0.05 - 0.15], abs=1e-4)
