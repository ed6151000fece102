import pytest

from experiments.scenario.seeds import parse_seeds
from mapfusion.errors import InputError


def test_seeds() -> None:
    assert parse_seeds("3") == [3]
    assert parse_seeds("0..4") == [0, 1, 2, 3, 4]
    assert parse_seeds("5,2,0") == [5, 2, 0]
    assert len(parse_seeds("0..999")) == 1000
    with pytest.raises(InputError, match="more than 1000"):
        parse_seeds("0..1000")
