"""A few seconds of each campaign over the files."""

from pathlib import Path

from tests.campaign import damaged_files, flipped_bits


def test_flipped_bits(tmp_path: Path) -> None:
    assert flipped_bits.explore("1", 300, tmp_path).faults == []


def test_damaged_files(tmp_path: Path) -> None:
    assert damaged_files.explore("1", 20, tmp_path).faults == []
