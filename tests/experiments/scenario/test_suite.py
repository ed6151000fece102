"""The suite: found by file, name or tag; what is shipped keeps its promises."""

import re
from pathlib import Path

import pytest

from experiments.scenario.loading import load_scenario, schema_text, setting_keys
from experiments.scenario.settings import Simulation
from experiments.scenario.suite import (
    COMMON_SETTINGS,
    copy_to_edit,
    entries,
    parse_seeds,
    scenarios_of,
    with_common_settings,
)
from experiments.scenario.suite import SHIPPED as SUITE
from mapfusion.errors import InputError
from mapfusion.fastslam.proposal import Proposal
from tests.helpers.tiny_scenario import assert_refused, command

SCENARIOS = Path(__file__).parents[3] / "scenarios"
SHIPPED = sorted(path.stem for path in SCENARIOS.glob("*.yaml"))
WORLD = """
schema_version: 1
name: {name}
description: "[bold]{name}[/bold] <b>"
tags: [{tags}]
world:
  walls:
    - points: [[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]]
robots:
  - {{name: R1, start: [1, 1, 0], route: [[5, 1]]}}
drive: {{frames: 5}}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "scenarios"
    folder.mkdir()
    for name, tags in (("a", "ci, hard"), ("b", "hard"), ("c", "")):
        (folder / f"{name}.yaml").write_text(WORLD.format(name=name, tags=tags))
    (folder / "notes.txt").write_text("no scenario")
    return folder


def found(folder: Path, *wanted: str | Path) -> list[str]:
    return [path.stem for path in scenarios_of(wanted, folder)]


def test_scenarios_are_found_by_tag_name_and_file(folder: Path) -> None:
    assert found(folder, "hard") == ["a", "b"]
    assert found(folder, "ci") == ["a"]
    assert found(folder, "c") == ["c"]
    assert found(folder, folder / "b.yaml", "c") == ["b", "c"]
    assert found(folder, "elsewhere/x.yaml", "y.yaml") == ["x", "y"]  # loading will complain


def test_each_is_found_once_in_the_order_asked_for(folder: Path) -> None:
    assert found(folder, "b", "hard", "ci") == ["b", "a"]


def test_an_unknown_name_lists_what_there_is(folder: Path) -> None:
    with pytest.raises(InputError, match=r"soft: neither a file.*\(a, b, c\).*\(ci, hard\)"):
        scenarios_of(["soft"], folder)
    with pytest.raises(InputError, match="there is none"):
        scenarios_of(["soft"], folder / "none")


def test_a_broken_file_is_named(folder: Path) -> None:
    (folder / "d.yaml").write_text("- 1")
    with pytest.raises(InputError, match=r"d\.yaml"):
        scenarios_of(["ci"], folder)


def test_a_name_is_that_of_the_file_and_of_all_that_say_so(folder: Path) -> None:
    (folder / "d.yaml").write_text(WORLD.format(name="a", tags=""))
    (folder / "e.yaml").write_text("- 1")  # which has nothing to do with it
    assert scenarios_of(["a"], folder) == [folder / "a.yaml", folder / "d.yaml"]


def test_the_listing_shows_names_as_they_are(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(capsys, "scenarios", folder)
    assert reply.code == 0
    assert "[bold]a[/bold] <b>" in reply.out
    assert "ci hard" in reply.out


def test_commands_take_tags(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder.parent)
    for name in ("run", "check"):
        assert_refused(
            command(capsys, name, "soft"), "soft", "a, alias_copy", "alias, ci, full, hard"
        )
    wrong = ("ci", "--set", "drive.frames=1")  # found, and then refused for their own reasons
    assert_refused(command(capsys, "run", *wrong), "a.yaml", "frames")
    checked = command(capsys, "check", *wrong)
    assert checked.code == 2
    files = [line.split(": ")[1].partition(", ")[0] for line in checked.complaints]
    assert [Path(file).name for file in files] == [
        "a.yaml",
        "quick.yaml",
    ]
    assert_refused(command(capsys, "scenarios", "nowhere"), "nowhere", "holds no scenario")


def test_the_suite_is_found_from_any_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert scenarios_of(["quick"]) == scenarios_of(["ci"]) == [SUITE / "quick.yaml"]
    assert [entry["name"] for entry in entries()] == SHIPPED
    assert "quick" in command(capsys, "scenarios").out
    log = load_scenario(SUITE / "mrclam7.yaml").logs[0]  # beside the folder that one works in
    assert log == str(tmp_path / "results" / "mrclam7" / "robot1")


def test_own_files_go_before_shipped_ones_of_their_name(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder.parent)
    (folder / "quick.yaml").write_text(WORLD.format(name="quick", tags="ci"))
    own = Path("scenarios")
    assert scenarios_of(["quick", "a"]) == [own / "quick.yaml", own / "a.yaml"]
    assert scenarios_of(["ci"]) == [own / "a.yaml", own / "quick.yaml"]
    assert scenarios_of(["dark"]) == [SUITE / "dark.yaml"]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenarios_say_what_they_are(name: str) -> None:
    path = SCENARIOS / f"{name}.yaml"
    scenario = load_scenario(path)
    assert scenario.name == name
    assert scenario.tags
    assert scenario.description
    assert path.read_text().startswith("# ")


@pytest.mark.parametrize(
    "name", [path.stem for path in scenarios_of(["full", "hard", "alias"], SCENARIOS)]
)
def test_worlds_of_the_suite_are_small(name: str) -> None:
    scenario = load_scenario(SCENARIOS / f"{name}.yaml")
    assert scenario.drive is not None
    assert scenario.drive.frames <= 500
    assert (scenario.camera.width_px, scenario.camera.height_px) == (640, 480)
    assert scenario.render.renderer == "raycast"  # of all, also where the file does not say it


@pytest.mark.parametrize("name", ["quick", "paper"])
def test_the_mission_s_own_scenarios_keep_pybullet_s_pictures(name: str) -> None:
    scenario = load_scenario(SCENARIOS / f"{name}.yaml")
    assert isinstance(scenario, Simulation)
    assert scenario.render.renderer == "tiny"


def test_the_paper_as_printed_drives_as_the_paper_does() -> None:
    """Only methods and renderer differ, so that both scenarios can be compared."""
    printed, usual = (
        load_scenario(SCENARIOS / f"{name}.yaml") for name in ("paper_as_printed", "paper")
    )
    assert isinstance(printed, Simulation)
    assert isinstance(usual, Simulation)
    for section in ("world", "robots", "drive", "camera", "odometry", "evaluate"):
        assert getattr(printed, section) == getattr(usual, section), section
    filtered = printed.slam.filter
    assert (filtered.proposal, filtered.close_loops) == (Proposal.MOTION, False)
    assert [entry.name for entry in printed.align.aligners] == ["ransac", "svd", "icp", "impicp"]
    assert printed.align.aligners[1].parameters == {"points": "space"}
    assert (printed.merge.fuser, printed.smooth.max_memory_gb) == ("kalman", 0)
    assert printed.fuse.fusers == ["kalman", "kalman_as_printed"]


def test_the_default_suite_is_five_worlds_that_fit_the_hour() -> None:
    full = scenarios_of(["full"], SCENARIOS)
    assert len(full) == 5
    frames = [(s.drive.frames if s.drive else 0) * len(s.robots) for s in map(load_scenario, full)]
    # ten seeds; 0.2 s a frame for rendering, features and filter on one of two cores: half an hour
    assert 10 * sum(frames) * 0.2 / 2 < 40 * 60
    assert "apart" in {path.stem for path in full}


def test_entries_hold_what_the_listing_shows() -> None:
    known = {entry["name"]: entry for entry in entries(SCENARIOS)}
    assert sorted(known) == SHIPPED
    assert known["apart"]["overlap"] == 0
    assert known["quick"]["overlap"] is None
    assert (known["quick"]["robots"], known["quick"]["iterations"]) == (2, 300)
    assert known["mrclam7"]["iterations"] is None


def test_seeds() -> None:
    assert parse_seeds("3") == [3]
    assert parse_seeds("0..4") == [0, 1, 2, 3, 4]
    assert parse_seeds("5,2,0") == [5, 2, 0]
    assert len(parse_seeds("0..999")) == 1000
    with pytest.raises(InputError, match="more than 1000"):
        parse_seeds("0..1000")


# A comment of the copy: a section, or a setting with its value and perhaps its description.
_HINT = re.compile(r"^( *)# ((?: {2})*\w+:(?: [^#]+)?(?: {2}# .+)?)$")
_KEYS = {part for key in COMMON_SETTINGS for part in key.split(".")}


def uncommented(text: str, original: str) -> str:
    """The copy with all of its new comments made settings."""
    old = set(original.splitlines())
    lines = []
    for line in text.splitlines():
        hint = _HINT.match(line)
        is_new = line not in old and hint and hint[2].split(":")[0].strip() in _KEYS
        lines.append(f"{hint[1]}{hint[2]}" if hint and is_new else line)
    return "\n".join(lines)


@pytest.mark.parametrize("path", sorted(SUITE.glob("*.yaml")), ids=lambda path: path.stem)
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
    assert set(COMMON_SETTINGS) <= set(setting_keys())


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
