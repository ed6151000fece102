import math
from pathlib import Path
from xml.etree import ElementTree as ET

from experiments.evaluation.metrics import CheckedScenario, Outcome
from experiments.reports.junit import write_junit
from experiments.scenario.settings import Bound


def test_junit_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "junit.xml"
    outcomes = [
        Outcome("quick", "fine", 0.5, Bound(max=1), {0: 0.4, 1: 0.6}),
        Outcome("quick", "bad <&>", 2, Bound(max=1), {0: 2}),
        Outcome("paper", "unknown", math.nan, Bound(min=1), {0: math.nan}),
    ]
    checks = [
        CheckedScenario("quick", outcomes[:2], elapsed_s={0: 1.5, 1: 2.25}),
        CheckedScenario("paper", outcomes[2:], elapsed_s={0: 4.0}),
    ]
    write_junit(path, checks)
    root = ET.parse(path).getroot()
    assert (root.get("tests"), root.get("failures"), root.get("time")) == ("6", "2", "7.750")
    assert root[0].get("time") == "3.750"
    cases = {case.get("name"): case for case in root.iter("testcase")}
    assert cases["run, seed 1"].get("time") == "2.250"
    assert cases["fine"].find("failure") is None
    failure = cases["bad <&>"].find("failure")
    assert failure is not None
    assert failure.get("message") == "2, expected x <= 1; by seed 0: 2"
    assert cases["unknown"].find("failure") is not None
    assert cases["unknown"].get("classname") == "paper"
