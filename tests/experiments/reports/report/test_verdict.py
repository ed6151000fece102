"""Tests of the first lines of the report, on rankings with a clear result."""

import math
from dataclasses import replace

from markupsafe import Markup

from experiments.reports.report.document import templates
from experiments.studies.method_comparison import Recommendation, Standing

GOOD = Standing(
    aligner="good",
    n_maps=20,
    n_alignments=20,
    rate=0.95,
    low=0.76,
    high=0.99,
    estimated_m=0.12,
    estimated_rad=0.01,
    refined_m=0.1,
    refined_rad=0.005,
    over_oracle=1.05,
    n_accepted=40,
    n_false=0,
    time_ms=1.0,
    shown={},
)
POOR = replace(GOOD, aligner="poor", rate=0.2, low=0.1, high=0.4, estimated_m=9.0, n_false=8)
ONE_RUN = Recommendation(
    best=GOOD,
    equals=(),
    standings=(GOOD, POOR),
    n_maps=24,
    n_common=20,
    n_runs=1,
    n_worlds=1,
    n_scenarios=1,
    oracle_m=0.095,
    oracle_rad=0.005,
)


def sentences(ranking: Recommendation, settings: tuple[str, ...] = ()) -> str:
    page = templates().get_template("verdict.html.j2")
    html = page.render(ranking=ranking, n_robot_pairs=1, settings=settings)
    return Markup(html).striptags().replace("\u00a0", " ")


def test_the_best_is_recommended_with_its_numbers() -> None:
    text = sentences(ONE_RUN)
    assert text.startswith("Use good good was correct in 95 % of 20 pairs of maps")
    assert "95 % interval 76 % to 99 %" in text
    assert "median error of 0.10 m and 0.0050 rad" in text
    assert "the error is 1.05 times the oracle's: the rest is the drift of the maps" in text
    assert "None of its 40 accepted results is wrong" in text
    assert "4 of the 24 pairs of maps have too little common ground" in text
    assert "Next is poor, correct in 20 %" in text


def test_a_method_worse_than_the_oracle_is_told_by_how_much() -> None:
    text = sentences(replace(ONE_RUN, best=replace(GOOD, over_oracle=2.34)))
    assert "the error is 2.34 times the oracle's." in text


def test_what_cannot_be_compared_is_not() -> None:
    few = sentences(replace(ONE_RUN, best=replace(GOOD, over_oracle=math.nan)))
    assert "reaches 0.095 m and 0.0050 rad. None" in few
    alone = replace(ONE_RUN, oracle_m=math.nan, best=replace(GOOD, over_oracle=math.nan))
    assert "There is no oracle to compare it with." in sentences(alone)


def test_false_merges_warn() -> None:
    warned = replace(ONE_RUN, best=replace(GOOD, n_false=10))
    assert "10 (25 %) are wrong: do not merge on acceptance alone" in sentences(warned)


def test_equal_methods_are_named() -> None:
    equal = replace(ONE_RUN, equals=("poor",))
    assert "poor performs equally well; good is the fastest" in sentences(equal)


def test_without_common_ground_no_method_is_named() -> None:
    nowhere = replace(ONE_RUN, best=None, n_common=0)
    text = sentences(nowhere)
    assert text.startswith("No common ground. None of the 24 pairs of maps")
    assert "False merges: poor (8)." in text


def test_where_nothing_works_no_method_is_named() -> None:
    assert sentences(replace(ONE_RUN, best=None)).startswith("No method worked.")


def test_a_method_that_mostly_fails_is_not_recommended() -> None:
    assert sentences(replace(ONE_RUN, best=POOR)).startswith("No method is reliable; the best is")


def test_one_run_is_indicative_and_settings_of_several_are_named() -> None:
    assert "Indicative: one run" in sentences(ONE_RUN)
    many = replace(ONE_RUN, n_runs=12, n_worlds=6)
    several = sentences(many, ("slam.filter.n_particles",))
    assert "Measured over 12 runs in 6 worlds" in several
    assert "apply to other seeds of the same scenario." in several
    assert "differ in slam.filter.n_particles" in several


def test_runs_in_few_worlds_say_nothing_of_other_seeds() -> None:
    """Ten settings in two worlds are twenty runs, and still two worlds."""
    for n_worlds, words in ((2, "2 worlds"), (1, "one world")):
        text = sentences(replace(ONE_RUN, n_runs=20, n_worlds=n_worlds))
        assert f"Indicative: measured over 20 runs in {words}." in text
        assert "a sweep over 6 seeds or more" in text
        assert "other seeds" not in text
