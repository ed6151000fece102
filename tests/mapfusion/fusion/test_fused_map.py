"""Names in the order that people expect."""

import pytest

from mapfusion.fusion.fusers import name_order


@pytest.mark.parametrize(
    "names",
    [
        ["R1", "R2", "R10"],
        ["2", "10", "A", "R", "R0", "R1", "R2b", "R02c", "R10", "robot 3"],
        ["", "1", "a"],
        ["R1", "R1" + "0" * 5000],  # more digits than `int` takes
        ["R01", "R1"],  # equal numbers, yet different names
    ],
)
def test_numbers_count_as_such(names: list[str]) -> None:
    shuffled = names[::-1]
    assert sorted(shuffled, key=name_order) == names
    assert len({str(name_order(name)) for name in names}) == len(names)
