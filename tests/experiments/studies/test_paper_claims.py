"""Claims of the paper against runs whose values are known."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from experiments.pipeline.tables import read_rows
from experiments.reports.study_files import claims_page
from experiments.studies.benchmark import CROSSING, crossing_shares
from experiments.studies.paper_claims import (
    CLAIMS,
    SCENARIOS,
    VALUES,
    NotMeasured,
    TablesOfRun,
    Verdict,
    claim_text,
    claims_table,
    compare_with_paper,
    verdict,
)
from mapfusion.errors import InputError

BY_NAME = {claim.name: claim for claim in CLAIMS}


@pytest.mark.parametrize(
    ("value", "low", "high", "expected"),
    [
        (0.05, 0.04, 0.06, Verdict.CONFIRMED),
        (0.05, 0.04, 0.11, Verdict.PARTLY),
        (0.2, 0.09, 0.3, Verdict.PARTLY),
        (0.2, 0.11, 0.3, Verdict.REFUTED),
        (0.05, math.nan, math.nan, Verdict.CONFIRMED),
        (math.inf, math.nan, math.nan, Verdict.REFUTED),
        (math.nan, math.nan, math.nan, Verdict.UNKNOWN),
    ],
)
def test_the_interval_decides(value: float, low: float, high: float, expected: Verdict) -> None:
    claim = BY_NAME["ransac_translation"]
    assert claim.confirms == (0.0, 0.1)
    assert verdict(claim, value, low, high) == expected


def alignments(error_of: dict[str, list[float]], n_true: list[int]) -> pd.DataFrame:
    """One repetition per iteration 200, 600 and 1000 with these errors."""
    rows = [
        {"aligner": aligner, "iteration": k, "translation_error_m": error, "n_true": n}
        for aligner, errors in error_of.items()
        for k, error, n in zip((200, 600, 1000), errors, n_true, strict=True)
    ]
    same = {"run_id": "r", "scenario": "paper", "seed": 0, "robot_a": "R1", "robot_b": "R2"}
    same |= {"repetition": 0, "rotation_error_rad": -0.02, "n_common": 50, "accepted": True}
    same |= {"refined_translation_error_m": 0.01, "refined_rotation_error_rad": 0.0}
    same |= {"n_correspondences": 100, "precision": 1.0}
    return pd.DataFrame(rows).assign(**same)


ERRORS = {"ransac": [0.02, 0.03, 0.04], "svd": [3.0, 1.0, 2.0]}
ERRORS |= {"icp": [8.0, 2.0, 4.0], "impicp": [math.nan, 0.5, 0.1]}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ransac_translation", 0.035),  # the first iteration has two true pairs only
        ("ransac_always", 0.04),
        ("svd_acceptable", 1.5),
        ("svd_below_ransac", 1.5 / 0.035),
        ("svd_before_icp", 0.5),
        ("icp_falls", 0.25),
        ("impicp_falls", 0.0),  # no answer at k = 200 is an infinite error
        ("icp_rises", 2.0),
        ("icp_translation", 8.0),
        ("impicp_translation", 0.5),
        ("ransac_rotation", 0.02),
        ("ransac_first", 0.3 / 0.035),
        ("icp_by_common_ground", -0.5),
        ("correspondences", 0.4),
        ("refinement", 1.0),
        ("no_start_poses", 1.0),
    ],
)
def test_values_of_alignments(name: str, value: float) -> None:
    tables = TablesOfRun({"errors": alignments(ERRORS, [2, 30, 40])}, "r")
    assert BY_NAME[name].of_run(tables) == pytest.approx(value)


def test_areas_of_ellipses_have_the_drift() -> None:
    """Round ellipses of variance 1 and 3 with a drift of 1 have the areas 2 and 4."""
    covariance = dict.fromkeys(("cov_xy_m2", "cov_xz_m2", "cov_yz_m2"), 0.0) | {"cov_zz_m2": 1.0}
    maps = [
        {"robot": robot, "landmark": 0, "cov_xx_m2": variance, "cov_yy_m2": variance} | covariance
        for robot, variance in (("R1", 1.0), ("R2", 3.0))
    ]
    fused = {"n_parents": 2, "robot_a": "R1", "robot_b": "R2", "landmark_a": 0, "landmark_b": 0}
    fused |= {"cov_xx_m2": 1.5, "cov_yy_m2": 1.5} | covariance
    motions = [{"robot": robot, "drift_sigma_m": 1.0, "tx_m": 0.0} for robot in ("R1", "R2")]
    rows = {"landmarks": maps, "fused": [fused], "fused_motions": motions}
    tables = TablesOfRun({k: pd.DataFrame(v).assign(run_id="r") for k, v in rows.items()}, "r")
    assert BY_NAME["two_ellipses"].of_run(tables) == pytest.approx(2.0)
    assert BY_NAME["smaller_ellipses"].of_run(tables) == pytest.approx(0.75)
    assert BY_NAME["one_map"].of_run(tables) == 1.0


def test_what_a_run_lacks_is_not_measured() -> None:
    tables = TablesOfRun({"errors": alignments(ERRORS, [2, 30, 40])}, "another run")
    for claim in CLAIMS:
        with pytest.raises(NotMeasured):
            claim.of_run(tables)


class OneRun:
    """Runs as `find_runs` gives them, of one run with the table `errors` alone."""

    def __init__(self, seed: int, renderer: str, scenario: str = "paper") -> None:
        run_id = f"{scenario}-{seed}"
        errors = alignments(ERRORS | {"ransac": [9.0, 0.01 * seed, 0.01 * seed]}, [2, 30, 40])
        self._errors = errors.assign(run_id=run_id, scenario=scenario, seed=seed)
        self.described = pd.DataFrame({"run_id": [run_id], "scenario": [scenario], "seed": [seed]})
        self.renderers = {run_id: renderer}

    def has(self, name: str) -> bool:
        return name == "errors"

    def read(self, name: str) -> pd.DataFrame:
        assert self.has(name)
        return self._errors


def test_renderers_and_scenarios_have_their_own_medians_over_runs() -> None:
    sources: Any = [*(OneRun(seed, "raycast") for seed in range(1, 10)), OneRun(5, "tiny")]
    sources += [OneRun(3, "raycast", "paper_as_printed"), OneRun(0, "raycast", "quick")]
    values = compare_with_paper(sources)
    own = values[values["name"] == "ransac_translation"].set_index(["scenario", "renderer"])
    assert own.index.tolist() == [
        ("paper_as_printed", "raycast"),
        ("paper", "raycast"),
        ("paper", "tiny"),
    ]
    assert own["value"].tolist() == pytest.approx([0.03, 0.05, 0.05])
    assert own["n_runs"].tolist() == [1, 9, 1]
    low, high = (own[name].tolist()[1] for name in ("value_low", "value_high"))
    assert 0.01 <= low < 0.05 < high <= 0.09
    assert own["value_low"].isna().tolist() == [True, False, True]
    with pytest.raises(InputError, match="run paper-5: was given twice with the renderer tiny"):
        compare_with_paper([*sources, sources[9]])


def test_names_of_claims_differ() -> None:
    assert len(BY_NAME) == len(CLAIMS)


def value_rows() -> pd.DataFrame:
    claim = BY_NAME["svd_before_icp"]
    row = {"name": claim.name, "where": claim.where, "claim": claim.text, "unit": claim.unit}
    row |= {"measure": claim.measure, "why": claim.why, "confirms_from": 0.0, "confirms_to": 1.0}
    of = [("paper_as_printed", 2.6, 1.5, 6.1, "refuted"), ("paper", math.nan, *2 * [math.nan], "")]
    names = ("scenario", "value", "value_low", "value_high", "verdict")
    more = {"renderer": "raycast", "n_runs": 10}
    return pd.DataFrame([row | dict(zip(names, own, strict=True)) | more for own in of])[
        VALUES.names
    ]


def test_a_cell_has_verdict_value_and_interval() -> None:
    records: Any = value_rows().to_dict("records")
    printed, _ = records
    assert claim_text(printed) == "**refuted**: 2.6 (1.5 to 6.1)"
    assert claims_table(value_rows()).columns.tolist() == [
        "claim",
        "measure",
        "paper_as_printed, raycast",
        "paper, raycast",
        "why",
    ]


def crossing() -> pd.DataFrame:
    errors = {"svd": [0.01, 0.04], "icp": [0.04, 0.01], "ransac": [0.01, 0.01]}
    rows = [
        {"unpaired_share": 0.75, "outlier_share": share, "method": method, "error_m": error}
        for method, own in errors.items()
        for share, error in zip((0.0, 0.1), own, strict=True)
    ]
    return pd.DataFrame(rows).assign(n_trials=9)[CROSSING.names]


def test_the_page_says_where_the_order_changes() -> None:
    page = claims_page(value_rows(), crossing())
    assert "the order changes at 5.0% of false pairs" in page
    assert "`paper_as_printed`: 10 by raycast" in page
    assert "2.6 (1.5 to 6.1)" in page


@pytest.mark.parametrize(
    ("first", "second", "shares"),
    [
        ([1.0, 4.0], [4.0, 1.0], [0.5]),
        ([1.0, 4.0], [2.0, 2.0], [0.5]),
        ([1.0, 2.0], [2.0, 4.0], []),
        ([1.0, math.inf], [2.0, 1.0], [0.5]),
        ([1.0, math.inf], [2.0, math.inf], []),
    ],
)
def test_crossings_are_where_the_ratio_is_one(
    first: list[float], second: list[float], shares: list[float]
) -> None:
    errors = pd.DataFrame({"a": first, "b": second}, index=np.array([0.0, 1.0]))
    assert crossing_shares(errors, "a", "b") == pytest.approx(shares)


def test_the_published_page_is_made_of_its_tables_and_the_present_claims() -> None:
    folder = Path(__file__).parents[3] / "results" / "reference" / "paper_claims"
    values = read_rows(folder / "claims.parquet", VALUES)
    crossing = read_rows(folder / "crossing.parquet", CROSSING)
    assert (folder / "paper.md").read_text(encoding="utf-8") == claims_page(values, crossing)
    told = ["name", "where", "claim", "measure", "unit", "why"]
    present = [(c.name, c.where, c.text, c.measure, c.unit, c.why) for c in CLAIMS]
    assert list(dict.fromkeys(values[told].itertuples(index=False, name=None))) == present
    of_runs = values.groupby("scenario")["n_runs"].max()
    assert (of_runs.reindex(SCENARIOS) >= 10).all()
