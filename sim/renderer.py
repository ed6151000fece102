"""The renderers: PyBullet's own, and the system's OpenGL without a screen (EGL)."""

import functools
import importlib.util
import os
import subprocess
import sys
from typing import Any, Literal

from mapfusion.errors import InputError

Renderer = Literal["tiny", "egl"]
RENDERER_NAMES = {"tiny": "TinyRenderer", "egl": "OpenGL by EGL"}
PLUGIN, PLUGIN_SYMBOL = "eglRenderer", "_eglRendererPlugin"
PROBE_S = 60  # a first picture takes a second, on a slow disk a few
NEEDED = (
    "render.renderer: egl does not work here ({reason}); it needs PyBullet's plug-in and the "
    "system's libEGL with a driver (on Debian: libegl1, libgl1-mesa-dri); renderer: tiny needs "
    "nothing"
)
_PROBE = "from sim.renderer import probe; probe()"


@functools.cache
def require_egl() -> None:
    """Raise InputError where EGL cannot draw.

    It is tried in a process of its own: without a driver the plug-in ends its process.
    """
    if importlib.util.find_spec(PLUGIN) is None:
        raise InputError(NEEDED.format(reason="the plug-in is not installed"))
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    environment = {**os.environ, "PYTHONPATH": root}
    try:
        tried = subprocess.run(  # noqa: S603 - our own text, no input of a user's
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, timeout=PROBE_S
        )
    except subprocess.TimeoutExpired:
        raise InputError(NEEDED.format(reason=f"no picture within {PROBE_S} s")) from None
    if tried.returncode:
        raise InputError(NEEDED.format(reason="it drew no picture"))


def probe() -> None:
    """Draw one small picture by EGL; anything but an exit code 0 means that it cannot."""
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    load_egl(pybullet, client)
    width = pybullet.getCameraImage(
        8, 8, renderer=pybullet.ER_BULLET_HARDWARE_OPENGL, physicsClientId=client
    )[0]
    sys.stdout.flush()
    # the library's own tidying up may fail after the picture
    os._exit(0 if width == 8 else 1)


def load_egl(bullet: Any, client: int) -> None:
    """Make a client draw by EGL; raises InputError where the plug-in does not load."""
    # Several threads would change nothing in a picture, but take cores from other processes.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    spec = importlib.util.find_spec(PLUGIN)
    loaded = -1
    if spec is not None and spec.origin is not None:
        loaded = bullet.loadPlugin(spec.origin, PLUGIN_SYMBOL, physicsClientId=client)
    if loaded < 0:
        raise InputError(NEEDED.format(reason="the plug-in does not load"))
