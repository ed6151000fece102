"""Outcomes of checks as a JUnit report, as continuous integration reads it."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

from experiments.judge.expectations import Outcome
from mapfusion.storage import write_whole


def write_junit(path: Path, outcomes: Sequence[Outcome]) -> None:
    """One JUnit test case per expectation."""
    failures = sum(not outcome.passed for outcome in outcomes)
    suite = ET.Element(
        "testsuite", name="mapfusion check", tests=str(len(outcomes)), failures=str(failures)
    )
    for outcome in outcomes:
        case = ET.SubElement(suite, "testcase", classname=outcome.scenario, name=outcome.metric)
        seeds = ", ".join(f"{seed}: {value:.4g}" for seed, value in outcome.per_seed.items())
        text = f"{outcome.value:.6g}, expected {outcome.bound_text}; by seed {seeds}"
        if outcome.passed:
            ET.SubElement(case, "system-out").text = text
        else:
            ET.SubElement(case, "failure", message=text)
    document = ET.ElementTree(suite)
    write_whole(path, lambda file: document.write(file, encoding="utf-8", xml_declaration=True))
