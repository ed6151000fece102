"""The limits that all judgements share, on rows at them and beside them."""

import pandas as pd
import pytest

from experiments.evaluation import criteria
from experiments.evaluation.alignment_summary import maps_of
from tests.helpers.made_up_runs import many_errors


@pytest.mark.parametrize(
    ("chosen", "least"), [(criteria.answerable, 3), (criteria.mergeable, 20), (criteria.rich, 30)]
)
def test_so_many_true_pairs_are_enough(chosen, least: int) -> None:
    rows = pd.DataFrame({"n_true": [least - 1, least, least + 1]})
    assert chosen(rows)["n_true"].tolist() == [least, least + 1]


def test_three_common_landmarks_are_common_ground() -> None:
    rows = pd.DataFrame({"n_common": [0, 2, 3, 4]})
    assert criteria.has_common_ground(rows).tolist() == [False, False, True, True]


def test_the_end_is_that_of_each_robot_pair_of_each_run() -> None:
    """A pair is judged as long as the later of its robots drives, others may go on."""
    columns = ["run_id", "robot_a", "robot_b", "iteration"]
    ends = [("x", "R1", "R2", 40), ("x", "R1", "R3", 90), ("y", "R1", "R2", 60)]
    earlier = [(*end[:3], end[3] - 10) for end in ends]
    rows = pd.DataFrame([*earlier, *ends, ends[1]], columns=pd.Index(columns))
    found = criteria.at_the_end(rows)
    assert [*found.itertuples(index=False, name=None)] == [*ends, ends[1]]
    alone = rows[rows["run_id"] == "x"].drop(columns="run_id")  # a result's own table
    assert criteria.at_the_end(alone)["iteration"].tolist() == [40, 90, 90]


@pytest.mark.parametrize("wrong", [{"translation_error_m": 0.6}, {"rotation_error_rad": -0.2}])
def test_an_estimate_and_its_refinement_are_judged_apart(wrong: dict[str, float]) -> None:
    right = {"translation_error_m": 0.4, "rotation_error_rad": -0.09}
    right |= {f"refined_{name}": value for name, value in right.items()}
    errors = many_errors(1, repetitions=1).assign(n_common=3)
    mended = maps_of(errors.assign(**(right | wrong)))
    assert (mended["estimated_success"] == 0).all()
    assert (mended["refined_success"] == 1).all()
    spoilt = {f"refined_{name}": value for name, value in wrong.items()}
    spoilt_maps = maps_of(errors.assign(**(right | spoilt), accepted=True))
    assert (spoilt_maps["estimated_success"] == 1).all()
    assert (spoilt_maps["refined_success"] == 0).all()
    assert (spoilt_maps["false_accepted"] == 1).all()
