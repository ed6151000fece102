"""The formats of recordings that can be read, by name. To add one: its file and one line here."""

import importlib
from dataclasses import dataclass
from pathlib import Path

from mapfusion.errors import InputError


@dataclass(frozen=True)
class Importer:
    """What reads recordings of one format.

    Attributes:
        target: `module:function` of it, imported when it is called. The function takes a
            recording's folder and where the logs go, writes a log (with the truth, if there is
            any) for each robot, and returns the logs' folders. It raises InputError that names
            file and line, and writes nothing then.
        what: the recordings, in a few words.
        example: how such a recording's folder may be called.
    """

    target: str
    what: str
    example: str


IMPORTERS = {
    "mrclam": Importer(
        "mapfusion.recordings.mrclam:import_mrclam", "UTIAS MRCLAM recordings", "MRCLAM_Dataset7"
    ),
}


def import_recording(format_name: str, folder: Path, destination: Path) -> list[Path]:
    """Write one log for each robot of a recording; returns the logs' folders.

    Raises:
        InputError: no importer has that name, or what it has to say against the recording.
    """
    if format_name not in IMPORTERS:
        raise InputError(f"recordings of {format_name!r}: unknown; known: {', '.join(IMPORTERS)}")
    module, _, function = IMPORTERS[format_name].target.partition(":")
    return getattr(importlib.import_module(module), function)(folder, destination)
