"""Plug-ins that misbehave: each ends as a recorded failure of that method, none ends a run."""

import importlib
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from experiments.pipeline.stages.align import estimate_row
from experiments.pipeline.tables import ESTIMATES, read_rows, write_rows
from experiments.plugins.discovery import callable_aligner, require_usable
from experiments.plugins.isolated_process import end_children
from mapfusion.align.alignment import Status
from mapfusion.verification.registration import Registration
from tests.campaign import misbehaviours as kinds
from tests.campaign.parts import Found
from tests.helpers.made_up_maps import landmark_map, paired
from tests.helpers.made_up_plugin import install, look_again

ALL = (*kinds.OF_ALIGN, *kinds.OF_FIND, *kinds.SLOW, *kinds.WHEN_MADE)
# What is done between two calls shows at the second, or later where the machine is busy.
# One that has ended by then is started anew, and what it answered stands.
_ENDED = "dies between two calls"
_CALLS, _MOST_CALLS, _PAUSE_S = 2, 50, 0.1
_LIMIT_S, _SHORT_LIMIT_S = 60.0, 1.0
_POINTS = np.random.default_rng(0).uniform(0, 10, (12, 3))
_MAPS = (landmark_map(_POINTS, "R1"), landmark_map(_POINTS + 1.0, "R2"))
_PAIRS = paired(list(range(12)), list(range(12)))


def source(name: str) -> str:
    """The code of the plug-in that does this."""
    if name in kinds.WHEN_MADE:
        return kinds.HEAD + kinds.ALIGN.format(body="pass") + kinds.WHEN_MADE[name] + "\n"
    if name in kinds.OF_FIND:
        return kinds.HEAD + kinds.FIND.format(body=kinds.OF_FIND[name])
    return kinds.HEAD + kinds.ALIGN.format(body=(kinds.OF_ALIGN | kinds.SLOW)[name])


def install_all(folder: Path) -> None:
    """Put a package of each kind into a folder that is on the path."""
    for number, name in enumerate(ALL):
        module = f"misbehaving_{number}"
        install(folder, module, module, target=f"{module}:Method", code=source(name))
    importlib.invalidate_caches()
    look_again()


def what_got_past(name: str, folder: Path) -> str:
    """Return the fault after a plug-in's misbehaviour; empty if it became a recorded failure.

    Registrations are written as rows of `estimates` into the folder and read again.
    """
    method = f"misbehaving_{ALL.index(name)}"
    if name in kinds.WHEN_MADE:
        try:
            require_usable(method, {})
            return "is usable"
        except ValueError as error:
            if not str(error).isprintable():
                return f"refused in a text that cannot be shown: {error!r}"
    limit_s = _SHORT_LIMIT_S if name in kinds.SLOW else _LIMIT_S
    registration, path = Registration(callable_aligner(method, {}, limit_s)), folder / "e.parquet"
    rows = list[dict[str, Any]]()
    while len(rows) < _CALLS or (_is_late(name) and not _failed(rows) and len(rows) < _MOST_CALLS):
        number = len(rows)
        done = registration.register(*_MAPS, _PAIRS, np.random.default_rng(number))
        names = {"robot_a": "R1", "robot_b": "R2", "iteration": 0, "aligner": "x"}
        rows.append(names | {"repetition": number} | estimate_row(len(_PAIRS), *done))
        time.sleep(_PAUSE_S)
    write_rows(path, ESTIMATES, rows)
    written = read_rows(path, ESTIMATES)
    failed = written[written["status"] == Status.FAILED]
    if failed.empty:
        return "" if name == _ENDED else f"recorded as {', '.join(written['status'])}"
    wordless = [text for text in failed["reason"] if not text or not text.isprintable()]
    accepted = failed["accepted"].any()
    return f"reasons {wordless}" if wordless else "failed and accepted" if accepted else ""


def _is_late(name: str) -> bool:
    return "between two calls" in name and name != _ENDED


def _failed(rows: list[dict[str, Any]]) -> bool:
    return any(row["status"] == Status.FAILED for row in rows)


def explore(folder: Path) -> Found:
    """Try all, once each."""
    faults = []
    sys.path.insert(0, str(folder))
    install_all(folder)
    for each in ALL:
        try:
            wrong = what_got_past(each, folder)
        except Exception as error:  # this is what the campaign looks for
            wrong = f"ended the run: {error!r}"
        faults += [f"{each}: {wrong}"] if wrong else []
    end_children()
    return Found(Counter(misbehaviours=len(ALL)), faults)
