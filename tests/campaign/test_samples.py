"""A few seconds of each campaign over the files."""

from pathlib import Path

import pytest

from tests.campaign import damaged_files, flipped_bits, surroundings
from tests.helpers import killing
from tests.helpers.tiny_scenario import SHORT


def test_flipped_bits(tmp_path: Path) -> None:
    assert flipped_bits.explore("1", 300, tmp_path).faults == []


def test_damaged_files(tmp_path: Path) -> None:
    assert damaged_files.explore("1", 20, tmp_path).faults == []


def test_surroundings(tmp_path: Path) -> None:
    assert surroundings.explore("1", 1, tmp_path).faults == []


def test_a_command_that_does_not_end_says_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = tmp_path / "short.yaml"
    scenario.write_text(SHORT, encoding="utf-8")
    with killing.KilledCommand(("run", scenario), tmp_path, jobs=1) as waiting:
        assert waiting.makes(1)
        waits = iter([0.1, killing.PATIENCE_S])  # no file more is let through: it hangs
        ended = waiting.process.communicate
        monkeypatch.setattr(
            waiting.process, "communicate", lambda timeout: ended(timeout=next(waits))
        )
        with pytest.raises(AssertionError, match=r"does not end:(.|\n)*most recent call first"):
            waiting.ended()
