"""Lenses and matrices from the mappings that calibration files hold (EuRoC's and Kalibr's keys)."""

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.errors import InputError
from mapfusion.recordings.lens import Distortion, Lens, require_rigid
from mapfusion.se2 import Float

_DISTORTIONS: dict[str, Distortion] = {
    "radial-tangential": "radial-tangential",
    "radtan": "radial-tangential",
    "plumb_bob": "radial-tangential",
    "equidistant": "equidistant",
    "none": "none",
}
_COEFFICIENTS = ("distortion_coefficients", "distortion_coeffs")


def lens_of(where: str, camera: Mapping[str, Any]) -> Lens:
    """A pinhole camera with its distortion.

    Args:
        where: file and place in it, for messages.
        camera: its mapping, with `camera_model: pinhole`, `intrinsics: [fu, fv, cu, cv]`,
            `resolution: [width, height]`, `distortion_model` and `distortion_coefficients`.

    Raises:
        InputError: one line that begins with `where`.
    """
    model = camera.get("camera_model", "pinhole")
    if model != "pinhole":
        raise InputError(f"{where}: camera_model: is {model!r}, only pinhole is read")
    named = str(camera.get("distortion_model", "none"))
    if named not in _DISTORTIONS:
        known = ", ".join(_DISTORTIONS)
        raise InputError(f"{where}: distortion_model: {named!r} is unknown; known: {known}")
    key = next((key for key in _COEFFICIENTS if key in camera), _COEFFICIENTS[0])
    coefficients = _numbers(where, camera, key, None, ()) if key in camera else []
    distortion = _DISTORTIONS[named]
    if distortion == "none" and not any(coefficients):
        coefficients = []
    fu, fv, cu, cv = _numbers(where, camera, "intrinsics", 4, ("fu", "fv", "cu", "cv"))
    width, height = _numbers(where, camera, "resolution", 2, ("width", "height"))
    if width % 1 or height % 1:
        raise InputError(f"{where}: resolution: must be whole numbers")
    try:
        size = (int(width), int(height))
        return Lens(size, (fu, fv), (cu, cv), distortion, tuple(coefficients))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def motion_of(where: str, key: str, holder: Mapping[str, Any]) -> Float:
    """A rigid motion (4, 4): rows of numbers, 16 numbers, or EuRoC's mapping with `data`.

    Args:
        where: file and place in it, for messages.
        key: of the motion.
        holder: the mapping that holds it.

    Raises:
        InputError: one line that begins with `where`.
    """
    value, wanted = holder.get(key), "4 rows of 4 numbers"
    if isinstance(value, Mapping):
        key, value = f"{key}.data", value.get("data")
    if value is None:
        raise InputError(f"{where}: {key}: is missing, expected {wanted}")
    try:
        T = np.array(value, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        raise InputError(f"{where}: {key}: is {_short(value)}, expected {wanted}") from None
    try:
        require_rigid(key, T)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    return T


def _short(value: Any) -> str:
    """A value as messages show it."""
    flat = (
        [each for row in value for each in (row if isinstance(row, list) else [row])]
        if (isinstance(value, list))
        else []
    )
    is_numbers = flat and all(isinstance(each, int | float) for each in flat)
    return f"{len(flat)} numbers" if is_numbers else reprlib.repr(value)


def section(where: Path, document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """A mapping within a document; raises InputError where there is none."""
    found = document.get(key)
    if not isinstance(found, Mapping):
        what = "is missing" if found is None else f"is {_short(found)}"
        raise InputError(f"{where}: {key}: {what}, expected a mapping")
    return found


def _numbers(
    where: str, camera: Mapping[str, Any], key: str, n: int | None, names: tuple[str, ...]
) -> list[float]:
    value: Any = camera.get(key)
    is_list = isinstance(value, list) and all(
        isinstance(each, int | float) and not isinstance(each, bool) for each in value
    )
    if not is_list or (n is not None and len(value) != n):
        wanted = f"a list [{', '.join(names)}]" if names else "a list of numbers"
        what = "is missing" if value is None else f"is {reprlib.repr(value)}"
        raise InputError(f"{where}: {key}: {what}, expected {wanted}")
    return [float(each) for each in value]
