"""Fusers by name, our own and those of installed packages; natural order of map names."""

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from mapfusion.fusion import fusers
from mapfusion.fusion.fusers import FUSERS, GROUP, make_fuser, name_order
from mapfusion.fusion.joint import JointFuser


class Other:
    """A fuser of another package."""

    smoothed = False

    def fuse(self, component: object, parameters: object) -> None:
        """Never called here."""


class NoFuser:
    """Lacks `fuse`."""

    smoothed = False


@pytest.fixture
def offered(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [
        EntryPoint("other", f"{__name__}:Other", GROUP),
        EntryPoint("joint", f"{__name__}:Other", GROUP),
        EntryPoint("none", f"{__name__}:NoFuser", GROUP),
        EntryPoint("gone", f"{__name__}:Gone", GROUP),
        EntryPoint("former", "fuser_with_former_import:Fuser", GROUP),
    ]
    monkeypatch.setattr(fusers, "entry_points", lambda group: entries)


@pytest.mark.parametrize("name", FUSERS)
def test_all_of_ours_can_be_made(name: str) -> None:
    assert isinstance(make_fuser(name).smoothed, bool)


@pytest.mark.usefixtures("offered")
def test_others_are_found_and_ours_come_first() -> None:
    assert isinstance(make_fuser("other"), Other)
    assert isinstance(make_fuser("joint"), JointFuser)


@pytest.mark.usefixtures("offered")
@pytest.mark.parametrize(
    ("line", "told"),
    [
        (
            "from mapfusion.fuse.component import Component",
            "mapfusion.fuse.component is now mapfusion.fusion.fusers",
        ),
        ("import mapfusion.fused_map", "mapfusion.fused_map is now mapfusion.fusion.fusers"),
        ("from mapfusion import se2", "mapfusion.se2 is now mapfusion.geometry.se2"),
    ],
)
def test_a_former_import_is_told_with_the_new_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, told: str
) -> None:
    (tmp_path / "fuser_with_former_import.py").write_text(f"{line}\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=f"fuser former: .*; {told}: change the import$"):
        make_fuser("former")


@pytest.mark.usefixtures("offered")
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("jont", "unknown fuser 'jont', known are kalman, .*; did you mean joint"),
        ("none", "fuser none: .*NoFuser has no fuse"),
        ("gone", "fuser gone: .*Gone cannot be made"),
    ],
)
def test_what_cannot_be_used_is_told(name: str, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        make_fuser(name)


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
