"""Checks as a JUnit report for continuous integration."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

from experiments.evaluation.metrics import CheckedScenario
from experiments.reports.formatting import plain
from mapfusion.files import write_whole


def write_junit(path: Path, checks: Sequence[CheckedScenario]) -> None:
    """Write one suite for each scenario, with a case for each run and for each expectation."""
    root = ET.Element("testsuites", name="mapfusion check")
    for check in checks:
        suite = ET.SubElement(root, "testsuite", name=plain(check.scenario))
        seeds = list(check.elapsed_s)
        for seed in seeds or [None]:
            elapsed_s = check.elapsed_s.get(seed, 0.0) if seed is not None else 0.0
            case = _case(suite, check, "run" if seed is None else f"run, seed {seed}", elapsed_s)
            if check.error and seed == (seeds[-1] if seeds else None):
                ET.SubElement(case, "error", message=plain(check.error))
            elif seed is None:
                ET.SubElement(case, "skipped", message="another scenario cannot be read")
            elif seed in check.unmerged:
                ET.SubElement(case, "failure", message=check.unmerged[seed].text)
        for outcome in check.outcomes:
            case = _case(suite, check, outcome.metric)
            by_seed = ", ".join(f"{seed}: {value:.4g}" for seed, value in outcome.per_seed.items())
            text = f"{outcome.value:.6g}, expected {outcome.bound_text}; by seed {by_seed}"
            if outcome.passed:
                ET.SubElement(case, "system-out").text = text
            else:
                ET.SubElement(case, "failure", message=text)
        _count(suite)
    _count(root)
    document = ET.ElementTree(root)
    write_whole(path, lambda file: document.write(file, encoding="utf-8", xml_declaration=True))


def _case(
    suite: ET.Element, check: CheckedScenario, name: str, elapsed_s: float = 0.0
) -> ET.Element:
    """Add a test case to a suite."""
    named = {"classname": plain(check.scenario), "name": name}
    return ET.SubElement(suite, "testcase", named, time=f"{elapsed_s:.3f}")


def _count(node: ET.Element) -> None:
    """Count cases, failures and seconds of the elements below."""
    cases = list(node.iter("testcase"))
    node.set("tests", str(len(cases)))
    for plural, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
        node.set(plural, str(sum(case.find(tag) is not None for case in cases)))
    node.set("time", f"{sum(float(case.get('time', 0)) for case in cases):.3f}")
