"""Settings of a scenario, as read from its file."""

import pytest

from experiments.scenario.loading import default_settings
from experiments.scenario.settings import DEFAULT_ALIGNERS, Align
from mapfusion.errors import InputError

ALSO = {"name": "peer", "method": "opencv"}


def test_also_goes_behind_the_default_list() -> None:
    align = Align.model_validate({"also": [ALSO]})
    assert [entry.name for entry in align.aligners] == [
        *(entry.name for entry in DEFAULT_ALIGNERS),
        "peer",
    ]
    assert Align.model_validate(align.model_dump(mode="json")) == align  # not added twice
    assert "peer" not in [entry.name for entry in Align().aligners]


@pytest.mark.parametrize(
    ("also", "said"),
    [
        ([ALSO, ALSO], "two are named peer"),
        ([{"name": "ransac", "method": "opencv"}], "two are named ransac"),
        ([{"name": "peer", "method": "nowhere"}], "also.0: unknown aligner 'nowhere'"),
    ],
)
def test_wrong_entries_are_named(also: list[dict], said: str) -> None:
    with pytest.raises(InputError, match=said):
        default_settings([f"align.also={also}".replace("'", "")])
