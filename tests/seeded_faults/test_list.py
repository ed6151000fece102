"""The list of faults keeps up with the source; running them is `python -m tests.seeded_faults`."""

import ast
from collections import Counter
from pathlib import Path

import pytest

from experiments.pipeline.stage import PACKAGES
from tests.seeded_faults.faults import ROOT, all_faults


@pytest.mark.parametrize("fault", all_faults(), ids=lambda fault: fault.name)
def test_a_fault_can_still_be_made_and_its_tests_are_there(fault) -> None:
    source = (ROOT / fault.file).read_text(encoding="utf-8")
    broken = fault.applied(source)
    assert ast.dump(ast.parse(broken)) != ast.dump(ast.parse(source))
    for test in fault.tests:
        file, _, name = test.partition("::")
        text = (ROOT / file).read_text(encoding="utf-8")
        assert f"def {name or 'test'}" in text


def test_names_are_unique_and_every_package_has_its_share() -> None:
    names = Counter(fault.name for fault in all_faults())
    assert max(names.values()) == 1
    folders = {Path(*Path(fault.file).parts[:2]) for fault in all_faults()}
    below = [path.parent for package in PACKAGES for path in (ROOT / package).glob("*/__init__.py")]
    assert {path.relative_to(ROOT) for path in below} <= folders
