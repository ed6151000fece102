"""The one test of better, against numbers from textbooks' tables."""

import numpy as np
import pytest

from experiments.studies.intervals import change_of_each_run, holm, log_ratio, mean_change


def test_ratios_of_equals_are_none_whatever_they_are() -> None:
    over, under = (
        np.array([2.0, 0.0, np.inf, np.inf, 1.0]),
        np.array([1.0, 0.0, np.inf, 1.0, np.inf]),
    )
    expected = [np.log(2), 0.0, 0.0, np.inf, -np.inf]
    np.testing.assert_array_equal(log_ratio(over, under), expected)


def test_students_t_worked_out_by_hand() -> None:
    """1, 2 and 3: t = 2 sqrt(3) with 2 degrees of freedom, whose 97.5 % quantile is 4.3027."""
    found = mean_change(np.array([1.0, 2.0, 3.0]))
    half = 4.3027 / np.sqrt(3)
    assert found == pytest.approx((2.0, 2 - half, 2 + half, 0.0742), abs=1e-4)


def test_without_an_estimate_an_error_is_a_thousand_times_larger() -> None:
    found = mean_change(np.array([np.inf, 0.0]))
    assert found.change == pytest.approx(np.log(1000) / 2)
    assert np.isfinite(found).all()


@pytest.mark.parametrize(
    ("changes", "p"), [([0.5] * 6, 1 / 32), ([0.0] * 6, np.nan), ([0.5], np.nan), ([], np.nan)]
)
def test_changes_that_do_not_vary(changes: list[float], p: float) -> None:
    assert mean_change(np.array(changes)).p == pytest.approx(p, nan_ok=True)


def test_holms_rule_worked_out_by_hand() -> None:
    """0.01 x 3, 0.03 x 2, and 0.04 x 1 raised to the one before; what is no test does not count."""
    np.testing.assert_allclose(
        holm(np.array([0.01, 0.04, np.nan, 0.03])), [0.03, 0.06, np.nan, 0.06]
    )


def test_a_run_has_one_change_and_a_single_run_those_of_its_maps() -> None:
    changes, runs = np.array([1.0, 2.0, 9.0, 5.0]), ["x", "x", "x", "y"]
    assert change_of_each_run(changes, runs, 2).tolist() == [2.0, 5.0]
    assert change_of_each_run(changes, runs, 2, mean=True).tolist() == [4.0, 5.0]
    assert change_of_each_run(changes, ["x"] * 4, 1).tolist() == changes.tolist()
