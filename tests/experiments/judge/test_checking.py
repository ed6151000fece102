"""Checks of several scenarios, of which some cannot be read or run."""

from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from experiments.evaluation.checks import check_all
from experiments.scenario.settings import AnyScenario
from mapfusion.errors import InputError
from tests.helpers.tiny_scenario import TINY, command


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    """Scenarios a, b and c, without expectations."""
    text = TINY.partition("expect:")[0]
    for name in "abc":
        (tmp_path / f"{name}.yaml").write_text(text.replace("name: tiny", f"name: {name}"))
    return sorted(tmp_path.glob("*.yaml"))


def junit(path: Path) -> tuple[ET.Element, dict[str, ET.Element]]:
    root = ET.parse(path).getroot()
    cases = root.iter("testcase")
    return root, {f"{case.get('classname')}: {case.get('name')}": case for case in cases}


def test_one_that_cannot_run_ends_itself_alone(
    three: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def run(scenario: AnyScenario, *_: object) -> Path:
        if scenario.name == "b" and scenario.seed == 1:
            raise InputError("scenario b: R1[/b]: the way leads through a wall\x1b")
        return tmp_path

    monkeypatch.setattr("experiments.evaluation.result.run_scenario", run)
    monkeypatch.setattr("experiments.evaluation.checks.check", lambda *_: [])
    monkeypatch.setattr("experiments.evaluation.checks.nothing_merged", lambda _: None)
    out = tmp_path / "deep" / "junit.xml"
    reply = command(capsys, "check", *three, "--seeds", "0..2", "--junit", out)
    assert reply.code == 2
    assert reply.complaints == ["mapfusion: scenario b: R1[/b]: the way leads through a wall\\x1b"]
    assert "1 of 3 scenarios could not be checked" in reply.out
    root, cases = junit(out)
    assert [root.get(name) for name in ("tests", "failures", "errors", "skipped")] == [*"8010"]
    assert {name for name in cases if name.startswith("b")} == {"b: run, seed 0", "b: run, seed 1"}
    error = cases["b: run, seed 1"].find("error")
    assert error is not None
    assert "through a wall" in str(error.get("message"))
    assert all(float(case.get("time", "x")) >= 0 for case in cases.values())
    assert [suite.get("name") for suite in root] == ["a", "b", "c"]


def test_none_is_run_where_one_cannot_be_read(
    three: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    three[1].write_text("schema_version: 1\nname: b\n")
    out = tmp_path / "junit.xml"
    reply = command(capsys, "check", *three, "nowhere", "--junit", out, "--results", tmp_path / "r")
    assert reply.code == 2
    assert len(reply.complaints) == 2
    assert not (tmp_path / "r").exists()
    root, cases = junit(out)
    assert [root.get(name) for name in ("tests", "errors", "skipped")] == [*"422"]
    assert cases["b: run"].find("error") is not None
    assert cases["nowhere: run"].find("error") is not None
    assert cases["a: run"].find("skipped") is not None


def test_a_defect_is_told_and_then_raised(three: list[Path]) -> None:
    def run(scenario: AnyScenario) -> Path:
        raise ZeroDivisionError("of ours")

    checks = check_all([str(three[0])], [0], (), run)
    told = next(checks)
    assert told.error == "ZeroDivisionError: of ours"
    assert list(told.elapsed_s) == [0]
    assert not told.passed
    with pytest.raises(ZeroDivisionError):
        next(checks)
