"""What `mapfusion import` shows of a stereo recording."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.run.stereo_logs import ImportedRecording
from experiments.show.terminal.layout import print_lines, print_table
from mapfusion.recordings.stereo_import import Imported

_MOST_DROPPED = 5  # pictures that are named one by one
_COLUMNS = [
    ("robot", ""),
    ("frames", "d"),
    ("seconds", ".1f"),
    ("way, m", ".1f"),
    ("observations\na frame", ".0f"),
    ("\nat least", "d"),
    ("linked\n%", ".0f"),
    ("odometry", ""),
    ("truth", ""),
]


def print_imported(recordings: Sequence[ImportedRecording], folders: Sequence[Path]) -> None:
    """The cameras, a line a robot, what was dropped, and where the logs are."""
    print_lines(one.about for one in recordings)
    note = "median over the frames; linked: share of the features of the frame before"
    print_table(_COLUMNS, [_row(log) for one in recordings for log in one.robots], "", note)
    print_lines(
        f"  {log.log.robot}: guessed motions: {log.guessed}, its map may break there; "
        "odometry of the wheels would tell them"
        for one in recordings
        for log in one.robots
        if log.guessed
    )
    dropped = [text for one in recordings for text in one.dropped]
    print_lines(f"  dropped: {each}" for each in dropped[:_MOST_DROPPED])
    if len(dropped) > _MOST_DROPPED:
        print_lines([f"  dropped: {len(dropped) - _MOST_DROPPED} more"])
    print_lines(map(str, folders))


def _row(one: Imported) -> tuple[object, ...]:
    log, seen = one.log, one.observations
    known = 0 if one.truth is None else int(np.isfinite(one.truth).all(axis=1).sum())
    return (
        log.robot,
        len(log),
        float(log.time_s[-1] - log.time_s[0]),
        float(np.hypot(*log.odometry[:, :2].T).sum()),
        float(np.median(seen)),
        int(seen[np.argmax(seen > 0) :].min()),  # tracks must last before any is observed
        100 * float(np.nanmedian(one.linked)),
        _odometry(one),
        f"{known} frames" if known else "none",
    )


def _odometry(one: Imported) -> str:
    if one.odometry_covariance is None:
        return "recorded"
    return f"pictures, {one.guessed} guessed" if one.guessed else "pictures"
