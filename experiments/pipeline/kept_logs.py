"""Robots' logs that stay in memory: a process that works on one robot again has its log already.

Parts of a stage, and the stages after one another, want the same few logs, and reading one takes as
long as some of what is done with it. What is read so must not be changed.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mapfusion.robot_log import RobotLog, read_log

# Bytes of all logs that are kept, in each process: some 300 000 observations with descriptors.
MOST_BYTES = 128e6


class KeptLogs:
    """Logs by their folders, the one last asked for at the end.

    Args:
        most_bytes: of their arrays; a log with more is read each time.
    """

    def __init__(self, most_bytes: float = MOST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._logs: dict[Path, tuple[tuple[int, ...], RobotLog]] = {}

    def read(self, folder: Path) -> RobotLog:
        """The log in a folder, as `read_log` has it; once more where a file has changed."""
        known = self._logs.pop(folder, None)
        version = _version(folder)
        if known is None or known[0] != version:
            known = version, read_log(folder)
        self._logs[folder] = known
        while sum(map(_n_bytes, self._kept())) > self._most_bytes:
            self._logs.pop(next(iter(self._logs)))
        return known[1]

    def _kept(self) -> Iterator[RobotLog]:
        return (log for _, log in self._logs.values())


def _version(folder: Path) -> tuple[int, ...]:
    """What tells that files of a folder are others, without reading them."""
    stats = [path.stat() for path in sorted(folder.iterdir())] if folder.is_dir() else []
    return tuple(number for stat in stats for number in (stat.st_ino, stat.st_mtime_ns))


def _n_bytes(log: RobotLog) -> int:
    parts = (vars(log), vars(log.observations))
    return sum(
        each.nbytes for own in parts for each in own.values() if isinstance(each, np.ndarray)
    )


kept_log = KeptLogs().read
