"""Tests of `experiments.scenario.editable_copy`."""

import re
from pathlib import Path

import pytest

from experiments.scenario.editable_copy import COMMON, copy_to_edit, with_common_settings
from experiments.scenario.loading import load_scenario, schema_text, setting_keys
from experiments.scenario.yaml_files import SHIPPED
from mapfusion.errors import InputError
from tests.helpers.tiny_scenario import assert_refused, command

# A comment of the copy: a section, or a setting with its value and perhaps its description.
_HINT = re.compile(r"^( *)# ((?: {2})*\w+:(?: [^#]+)?(?: {2}# .+)?)$")
_KEYS = {part for key in COMMON for part in key.split(".")}


def uncommented(text: str, original: str) -> str:
    """The copy with all of its new comments made settings."""
    old = set(original.splitlines())
    lines = []
    for line in text.splitlines():
        hint = _HINT.match(line)
        is_new = line not in old and hint and hint[2].split(":")[0].strip() in _KEYS
        lines.append(f"{hint[1]}{hint[2]}" if hint and is_new else line)
    return "\n".join(lines)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.yaml")), ids=lambda path: path.stem)
def test_commented_values_are_the_present_ones(path: Path, tmp_path: Path) -> None:
    text = with_common_settings(path)
    copy, changed = tmp_path / "copy.yaml", tmp_path / "changed.yaml"
    copy.write_text(text)
    changed.write_text(uncommented(text, path.read_text()))
    assert changed.read_text() != text
    expected = load_scenario(copy).resolved()
    assert expected == load_scenario(changed).resolved()
    original = load_scenario(path).resolved()
    for each in (expected, original):
        each.pop("logs", None)  # their folder is relative to the file
    assert expected == original


def test_common_settings_exist() -> None:
    assert set(COMMON) <= set(setting_keys())


def test_a_copy_to_edit_is_written_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    reply = command(capsys, "scenarios", "--copy", "rooms_high")
    assert (reply.code, reply.out.split()) == (
        0,
        ["scenarios/rooms_high.yaml", "scenarios/schema.json"],
    )
    copy = Path("scenarios/rooms_high.yaml")
    first, *lines = copy.read_text().splitlines()
    assert first == "# yaml-language-server: $schema=schema.json"
    assert any(line.startswith("  # robots: 2  # number of robots") for line in lines)
    assert Path("scenarios/schema.json").read_text() == schema_text()
    copy.write_text("mine")
    with pytest.raises(InputError, match=r"scenarios/rooms_high\.yaml: exists"):
        copy_to_edit("rooms_high")
    assert copy.read_text() == "mine"
    for name in ("none", "../../quick", ""):
        assert_refused(command(capsys, "scenarios", "--copy", name), "no scenario of the suite")
