"""A sample of the campaign of misbehaving plug-ins; tests/campaign tries all of them."""

import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from experiments.plugins.isolated_process import end_children
from tests.campaign import misbehaving_plugins as campaign
from tests.helpers.made_up_plugin import look_again

SAMPLE = (
    "raises a lone surrogate",
    "dies of a real-time signal",
    "writes a pickle that claims memory",
    "writes half a frame and sleeps",
    "changes what is finite",
    "masked covariance",
    "longdouble motion that overflows",
    "negative drift",
    "finds masked weights",
    "writes when imported",
)


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("misbehaving")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        campaign.install_all(folder)
        yield folder
    importlib.invalidate_caches()
    look_again()
    end_children()


@pytest.mark.parametrize("name", SAMPLE)
def test_a_misbehaviour_is_a_recorded_failure(name: str, folder: Path) -> None:
    assert campaign.what_got_past(name, folder) == ""


def test_there_are_enough_of_them() -> None:
    assert len(set(campaign.ALL)) == len(campaign.ALL) >= 60
