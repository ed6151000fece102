"""The formats of recordings that can be read, by name. To add one: its file and one line here."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from mapfusion.errors import InputError


@dataclass(frozen=True)
class Importer:
    """What reads recordings of one format.

    Attributes:
        target: `module:function` of it, imported when it is called. The function takes a
            recording's folder, where the logs go and its settings, writes a log (with the truth,
            if there is any) for each robot, and returns the logs' folders. It raises InputError
            that names file and line, and writes nothing then.
        settings: name of the dataclass of its settings, in the same module.
        what: the recordings, in a few words.
        example: how such a recording's folder may be called.
    """

    target: str
    settings: str
    what: str
    example: str


IMPORTERS = {
    "mrclam": Importer(
        "mapfusion.recordings.mrclam:import_mrclam",
        "MrclamSettings",
        "UTIAS MRCLAM recordings",
        "MRCLAM_Dataset7",
    ),
}


def settings_class(format_name: str) -> type[Any]:
    """The dataclass of an importer's settings; raises InputError for an unknown name."""
    module, _ = _found(format_name)
    return getattr(module, IMPORTERS[format_name].settings)


def import_recording(
    format_name: str, folder: Path, destination: Path, settings: Any = None
) -> list[Path]:
    """Write one log for each robot of a recording; returns the logs' folders.

    Settings are of the importer's `settings_class`, by default with all its defaults.

    Raises:
        InputError: no importer has that name, or what it has to say against the recording.
    """
    _, function = _found(format_name)
    return function(folder, destination, settings)


def _found(format_name: str) -> tuple[ModuleType, Callable[..., list[Path]]]:
    if format_name not in IMPORTERS:
        raise InputError(f"recordings of {format_name!r}: unknown; known: {', '.join(IMPORTERS)}")
    module, _, function = IMPORTERS[format_name].target.partition(":")
    found = importlib.import_module(module)
    return found, getattr(found, function)
