"""A sample of the campaign of broken scenarios; `mutated_scenarios.py` has all of it."""

from pathlib import Path

from tests.campaign.mutated_scenarios import campaign


def test_each_of_300_mutants_is_a_scenario_or_one_line(tmp_path: Path) -> None:
    seen, faults = campaign(seed=7, count=300, runs=0, folder=tmp_path)
    assert not faults
    assert min(seen["valid"], seen["refused"]) > 30  # both were tried
