"""Renderers: PyBullet's TinyRenderer, OpenGL without a screen (EGL), and the ray caster."""

import functools
import importlib.util
import os
import subprocess
import sys
from typing import Any, Literal

from mapfusion.errors import InputError, not_installed

BulletRenderer = Literal["tiny", "egl"]
Renderer = Literal["tiny", "egl", "raycast"]
NAMES = {"tiny": "TinyRenderer", "raycast": "our ray caster"}
PLUGIN, PLUGIN_SYMBOL = "eglRenderer", "_eglRendererPlugin"
NEWEST_WHEEL = (3, 11)  # last version of Python with wheels of PyBullet
PROBE_S = 60  # the first image takes a second, on a slow disk a few seconds
NEEDED = (
    "render.renderer: egl does not work here ({reason}); it needs PyBullet's plug-in and the "
    "system's libEGL with a driver (on Debian: libegl1, libgl1-mesa-dri); renderer: tiny needs "
    "nothing"
)
_PROBE = "from sim.renderer import probe; probe()"


def require_pybullet() -> None:
    """Raise InputError if PyBullet is not installed; nothing is imported."""
    if importlib.util.find_spec("pybullet") is None:
        how = not_installed("pybullet", "sim")
        if sys.version_info[:2] > NEWEST_WHEEL:
            how += " (pip compiles it for this Python, see `mapfusion docs installation`)"
        raise InputError(f"a simulated world needs PyBullet: {how}")


@functools.cache
def egl_driver() -> str:
    """Return name and version of the EGL driver; raises InputError without a working one.

    The test runs in a process of its own, because the plug-in ends its process without a driver.
    """
    require_pybullet()
    if importlib.util.find_spec(PLUGIN) is None:
        raise InputError(NEEDED.format(reason="the plug-in is not installed"))
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    environment = {**os.environ, "PYTHONPATH": root}
    try:
        tried = subprocess.run(  # noqa: S603 - a constant text, no user input
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, timeout=PROBE_S
        )
    except subprocess.TimeoutExpired:
        raise InputError(NEEDED.format(reason=f"no image within {PROBE_S} s")) from None
    if tried.returncode:
        raise InputError(NEEDED.format(reason="it drew no image"))
    lines = tried.stdout.decode(errors="replace").splitlines()
    properties = dict(
        line.split("=", 1) for line in lines if line.startswith("GL_") and "=" in line
    )
    return ", ".join(
        properties[name] for name in ("GL_RENDERER", "GL_VERSION") if name in properties
    )


def renderer_name(renderer: Renderer) -> str:
    """Return the name of a renderer in the results."""
    return NAMES[renderer] if renderer in NAMES else f"OpenGL by EGL ({egl_driver()})"


def probe() -> None:
    """Draw one small image by EGL; an exit code other than 0 means that EGL does not work."""
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    load_egl(pybullet, client)
    pybullet.disconnect(physicsClientId=client)


def load_egl(bullet: Any, client: int) -> None:
    """Load the EGL plug-in into a client; raises InputError if it does not load."""
    # more threads do not change the image and take cores from other processes
    os.environ.setdefault("LP_NUM_THREADS", "1")
    spec = importlib.util.find_spec(PLUGIN)
    loaded = -1
    if spec is not None and spec.origin is not None:
        loaded = bullet.loadPlugin(spec.origin, PLUGIN_SYMBOL, physicsClientId=client)
    if loaded < 0:
        raise InputError(NEEDED.format(reason="the plug-in does not load"))
    # the plug-in writes to stdout during its first two images
    size, opengl = (8, 8), bullet.ER_BULLET_HARDWARE_OPENGL
    for _ in range(2):
        if bullet.getCameraImage(*size, renderer=opengl, physicsClientId=client)[:2] != size:
            raise InputError(NEEDED.format(reason="it drew no image"))
