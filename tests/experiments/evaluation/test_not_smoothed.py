"""A robot that cannot be smoothed ends no run: what stands in is stored, judged and shown."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation import tables
from experiments.evaluation.result import run_scenario
from experiments.pipeline.stages import smooth
from experiments.reports.report.document import write_report
from experiments.reports.terminal.run_screen import print_result
from experiments.scenario.loading import load_scenario

EARLY, LAST = 40, 43  # iterations that maps of the tiny scenario are fused at
BOTH = ("R1", "R2")
EARLIER = f"its map until frame {EARLY} stands in"
FILTER_S = "FastSLAM's map stands in"


def fails_at(monkeypatch: pytest.MonkeyPatch, places: list[tuple[str, int]]) -> None:
    """Have smoothing fail for robots at iterations."""
    works = smooth.smooth_log

    def fails(settings, log, landmark, path, attitude):
        if (log.robot, len(log) - 1) not in places:
            return works(settings, log, landmark, path, attitude)
        return None, np.empty((0, 3)), landmark, (0, np.nan, np.nan, np.nan, "fails here")

    monkeypatch.setattr(smooth, "smooth_log", fails)


@pytest.mark.parametrize(
    ("places", "instead"),
    [
        ([("R1", EARLY), ("R1", LAST)], {"R1": FILTER_S}),
        ([("R1", EARLY), ("R2", LAST)], {"R2": EARLIER}),
        ([(name, k) for name in BOTH for k in (EARLY, LAST)], dict.fromkeys(BOTH, FILTER_S)),
    ],
)
def test_the_run_ends_and_says_what_stands_in(
    places: list[tuple[str, int]],
    instead: dict[str, str],
    tiny_path: Path,
    tiny_results: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(tiny_results / "store", tmp_path / "store")
    fails_at(monkeypatch, places)
    scenario = load_scenario(tiny_path, ["smooth.max_memory_gb=0.9"])  # a key of its own
    result = run_scenario(scenario, tmp_path, 1, lambda *_: None)
    told = {name: f"{name} is not smoothed: fails here; {what}" for name, what in instead.items()}

    smoother = tables.read(tables.table_path(result, "smoother"), "smoother")
    reasons = smoother.set_index("robot")["not_smoothed"]
    assert reasons.to_dict() == {
        name: f"fails here; {instead[name]}" if name in instead else "" for name in BOTH
    }
    rows = tables.read(tables.table_path(result, "fusers"), "fusers").set_index(
        ["fuser", "iteration"]
    )
    assert rows["n_robots"].eq(2).all()  # nobody is left out for it
    said = rows["fallback"]
    assert said["joint", LAST] == "; ".join(told.values())
    early = [name for name in BOTH if (name, EARLY) in places]
    assert [name in said["joint", EARLY] for name in BOTH] == [name in early for name in BOTH]
    assert not said["kalman"].any()  # it is given the filter's maps as ever
    coverage = tables.read(tables.table_path(result, "fuser_coverage"), "fuser_coverage")
    given = set(coverage["map"])
    assert ("smoothed" in given) == (list(instead.values()) != [FILTER_S] * 2)

    print_result(result, ())
    screen, page = capsys.readouterr().out, write_report(result).read_text(encoding="utf-8")
    shown = " ".join(screen.split())
    for line in told.values():
        assert line in shown
        assert line.replace("'", "&#39;") in page
    assert ("stands in" in shown) == ("stands in" in page) == bool(instead)
