"""What a process has read of a robot it does not read again."""

from pathlib import Path

import pytest

from experiments.run.stages import snapshots
from experiments.run.stages.slam import RobotFolders
from experiments.run.stages.snapshots import ROBOTS_KEPT, stored_log


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Logs in the order in which they were read; they hold nothing."""
    found = list[Path]()

    def read_log(path: Path) -> object:
        found.append(path)
        return object()

    monkeypatch.setattr(snapshots, "read_log", read_log)
    stored_log.cache_clear()
    return found


def test_a_log_is_read_once(read: list[Path]) -> None:
    folders = RobotFolders(Path("log"), Path("slam") / "key")
    first = stored_log(folders)
    assert stored_log(RobotFolders(*folders)) is first
    assert read == [folders.log]
    stored_log.cache_clear()


def test_a_log_of_other_content_is_read_anew(read: list[Path]) -> None:
    """A recorded one stays where it is; the folder of its maps has the name of what it holds."""
    log = Path("recorded")
    first, second = (stored_log(RobotFolders(log, Path(key))) for key in ("before", "after"))
    assert first is not second
    assert read == [log, log]
    stored_log.cache_clear()


def test_only_a_few_logs_stay_in_memory(read: list[Path]) -> None:
    robots = [RobotFolders(Path(f"R{k}"), Path("slam")) for k in range(ROBOTS_KEPT + 1)]
    for folders in [*robots, robots[-1], robots[0]]:
        stored_log(folders)
    assert read == [folders.log for folders in [*robots, robots[0]]]
    stored_log.cache_clear()
