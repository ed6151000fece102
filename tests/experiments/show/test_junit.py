import math
from pathlib import Path
from xml.etree import ElementTree as ET

from experiments.judge.expectations import Outcome
from experiments.scenario.settings import Bound
from experiments.show.junit import write_junit


def test_junit_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "junit.xml"
    outcomes = [
        Outcome("quick", "fine", 0.5, Bound(max=1), {0: 0.4, 1: 0.6}),
        Outcome("quick", "bad <&>", 2, Bound(max=1), {0: 2}),
        Outcome("paper", "unknown", math.nan, Bound(min=1), {0: math.nan}),
    ]
    write_junit(path, outcomes)
    suite = ET.parse(path).getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("3", "2")
    cases = {case.get("name"): case for case in suite.iter("testcase")}
    assert cases["fine"].find("failure") is None
    failure = cases["bad <&>"].find("failure")
    assert failure is not None
    assert failure.get("message") == "2, expected x <= 1; by seed 0: 2"
    assert cases["unknown"].find("failure") is not None
    assert cases["unknown"].get("classname") == "paper"
