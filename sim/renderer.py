"""The renderers: PyBullet's own, the system's OpenGL without a screen (EGL), our ray caster."""

import functools
import importlib.util
import os
import subprocess
import sys
from typing import Any, Literal

from mapfusion.errors import InputError

BulletRenderer = Literal["tiny", "egl"]
Renderer = Literal["tiny", "egl", "raycast"]
NAMES = {"tiny": "TinyRenderer", "raycast": "our ray caster"}
PLUGIN, PLUGIN_SYMBOL = "eglRenderer", "_eglRendererPlugin"
PROBE_S = 60  # a first picture takes a second, on a slow disk a few
NEEDED = (
    "render.renderer: egl does not work here ({reason}); it needs PyBullet's plug-in and the "
    "system's libEGL with a driver (on Debian: libegl1, libgl1-mesa-dri); renderer: tiny needs "
    "nothing"
)
_PROBE = "from sim.renderer import probe; probe()"


@functools.cache
def egl_driver() -> str:
    """Name and version of what draws by EGL; raises InputError where it cannot.

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
    lines = tried.stdout.decode(errors="replace").splitlines()
    told = dict(line.split("=", 1) for line in lines if line.startswith("GL_") and "=" in line)
    return ", ".join(told[name] for name in ("GL_RENDERER", "GL_VERSION") if name in told)


def renderer_name(renderer: Renderer) -> str:
    """What results call the renderer that made their images."""
    return NAMES[renderer] if renderer in NAMES else f"OpenGL by EGL ({egl_driver()})"


def probe() -> None:
    """Draw one small picture by EGL; anything but an exit code 0 means that it cannot."""
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    load_egl(pybullet, client)
    pybullet.disconnect(physicsClientId=client)


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
    # the plug-in talks on stdout during its first two pictures
    size, opengl = (8, 8), bullet.ER_BULLET_HARDWARE_OPENGL
    for _ in range(2):
        if bullet.getCameraImage(*size, renderer=opengl, physicsClientId=client)[:2] != size:
            raise InputError(NEEDED.format(reason="it drew no picture"))
