"""Medians and bands of few rows, worked out by hand."""

import numpy as np
import pandas as pd
import pytest

from experiments.studies.statistics import error_bands, medians_of_run, scarce_spans, time_bands

KEYS = {"run_id": "x-0", "scenario": "x", "seed": 0, "robot_a": "A", "robot_b": "B"}


def rows_of(iteration: int, off: list[float], **more: object) -> pd.DataFrame:
    """Make repetitions with these errors in m, and the negative ones in rad."""
    names = ("translation_error_m", "refined_translation_error_m")
    rows = pd.DataFrame(dict.fromkeys(names, off))
    for name in ("rotation_error_rad", "refined_rotation_error_rad"):
        rows[name] = -rows["translation_error_m"]
    counts = {"n_correspondences": 90, "n_true": 9, "n_common": 50}
    about = KEYS | {"iteration": iteration, "aligner": "icp"} | counts | more
    return rows.assign(**about, repetition=range(len(off)))


def test_the_line_is_the_median_and_the_band_holds_four_fifths() -> None:
    """The values are 0, 1, ..., 9 and 100: 10 % lie below 1 and 90 % below 9."""
    (row,) = error_bands(rows_of(5, [*map(float, range(10)), 100.0])).to_dict("records")
    names = [f"translation_error_m{end}" for end in ("_low", "", "_high")]
    assert [row[name] for name in names] == [1.0, 5.0, 9.0]
    names = [f"rotation_error_rad{end}" for end in ("_low", "", "_high")]
    assert [row[name] for name in names] == [-9.0, -5.0, -1.0]
    unsigned = error_bands(rows_of(5, [1.0, -2.0, 4.0]), absolute=True)
    assert unsigned["rotation_error_rad"].tolist() == [2.0]


@pytest.mark.parametrize(
    ("off", "length_m", "angle_rad"),
    [
        ([1.0, 2.0, 9.0, np.nan], 5.5, -2.0),
        ([1.0, 2.0, np.nan, np.nan], np.inf, np.nan),  # a half is not most
        ([1.0, np.nan, np.nan], np.inf, np.nan),
    ],
)
def test_rows_without_an_estimate_are_far_off_and_have_no_side(
    off: list[float], length_m: float, angle_rad: float
) -> None:
    rows = rows_of(5, off)
    for (found,) in (
        error_bands(rows).to_dict("records"),
        medians_of_run(rows).to_dict("records"),
    ):
        assert found["refined_translation_error_m"] == length_m
        assert found["refined_rotation_error_rad"] == pytest.approx(angle_rad, nan_ok=True)


def test_a_run_counts_by_its_median() -> None:
    rows = pd.concat([rows_of(5, [1.0, 2.0, 30.0]), rows_of(6, [4.0, 4.0, 5.0], n_true=12)])
    found = medians_of_run(rows)
    assert found["translation_error_m"].tolist() == [2.0, 4.0]
    assert found["rotation_error_rad"].tolist() == [-2.0, -4.0]
    assert found["n_true"].tolist() == [9, 12]


@pytest.mark.parametrize(
    ("n_true", "spans"),
    [
        ([[2], [3], [9]], [(-5.0, 5.0)]),
        ([[2, 9], [2, 2], [2, 9]], [(5.0, 15.0)]),  # one map of two is not most
        ([[9], [9], [0]], [(15.0, 25.0)]),
    ],
)
def test_too_few_true_pairs_in_most_maps(n_true: list[list[int]], spans: list) -> None:
    rows = [
        rows_of(10 * k, [0.1, 0.2], n_true=n, robot_b=f"B{i}")
        for k, maps in enumerate(n_true)
        for i, n in enumerate(maps)
    ]
    assert scarce_spans(pd.concat(rows)) == spans


def test_times_are_medians_of_groups_of_like_overlap() -> None:
    seconds = [1.0, 2.0, 30.0, 4.0, 5.0, 60.0]
    timings = pd.DataFrame({"n_common": [1, 2, 3, 7, 8, 12], "elapsed_s": seconds})
    found = time_bands(timings.assign(aligner="icp"), groups=2)
    assert found["elapsed_s"].tolist() == [2.0, 5.0]
    assert found["elapsed_low_s"].tolist() == pytest.approx([1.2, 4.2])
    assert found["elapsed_high_s"].tolist() == pytest.approx([24.4, 49.0])
    assert found["n_common"].tolist() == [2, 8]
    assert (found["n_common_low"].tolist(), found["n_common_high"].tolist()) == ([1, 7], [3, 12])
