"""A few seconds of each campaign over the files."""

from pathlib import Path

from tests.campaign.damaged_files import damage
from tests.campaign.flipped_bits import flips


def test_flipped_bits(tmp_path: Path) -> None:
    assert flips(tmp_path, 1, 300) == []


def test_damaged_files(tmp_path: Path) -> None:
    assert damage(tmp_path, 1, 20) == []
