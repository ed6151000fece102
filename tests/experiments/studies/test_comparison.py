"""Tests of the comparison of two versions."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation.alignment_criteria import ERROR_COLUMNS
from experiments.studies.comparison import (
    BETTER,
    NOISE,
    READ,
    SAME,
    WORSE,
    VersionComparison,
    compare,
    compare_values,
)
from experiments.studies.intervals import holm
from mapfusion.errors import InputError
from mapfusion.files import read_json, write_json
from tests.helpers.made_up_runs import (
    Tables,
    errors_of,
    scaled,
    tables_of,
    timings_of,
    two_sweeps,
    write_result,
    write_sweep,
)


def verdicts(table: pd.DataFrame) -> dict[tuple[str, str], str]:
    return {(row["metric"], row["method"]): row["verdict"] for row in table.to_dict("records")}


def test_the_same_tables_are_identical(tmp_path: Path) -> None:
    found = compare(*two_sweeps(tmp_path, lambda seed, made: made))
    assert set(found.table["verdict"]) == {SAME}
    assert found.table["p"].isna().all()
    assert not found.worse
    assert found.n_runs == 12


@pytest.mark.parametrize(("factor", "verdict"), [(1.5, WORSE), (0.7, BETTER)])
def test_a_method_that_changed_is_found_and_no_other(
    factor: float, verdict: str, tmp_path: Path
) -> None:
    found = compare(*two_sweeps(tmp_path, scaled(factor, "ransac", scatter=0.2)))
    of = verdicts(found.table)
    assert of[("estimated error, m", "ransac")] == verdict
    assert of[("estimated error, m", "icp")] == SAME
    assert of[("path RMSE, m", "")] == SAME
    row = found.table[
        (found.table["metric"] == "estimated error, m") & (found.table["method"] == "ransac")
    ].iloc[0]
    assert row["low"] < row["change"] < row["high"]
    assert row["change"] == pytest.approx(factor, rel=0.15)
    assert found.worse == (verdict == WORSE)


def test_chance_alone_is_rarely_taken_for_a_change(tmp_path: Path) -> None:
    """Other random numbers in everything: of 10 comparisons at 5 %, corrected, 1 may err."""
    wrong = 0
    a = write_sweep(tmp_path / "a", range(8))
    for trial in range(10):
        redrawn = {seed: tables_of(1000 * (trial + 1) + seed) for seed in range(8)}
        found = compare(a, write_sweep(tmp_path / str(trial), range(8), made=redrawn))
        wrong += found.table["verdict"].isin([BETTER, WORSE]).any()
        assert (found.table["verdict"] == NOISE).any()
        p = found.table["p"].to_numpy()
        np.testing.assert_array_equal(found.table["p_holm"], holm(p))
        # the smallest of m is judged at a level of 0.05 / m
        assert np.nanmin(found.table["p_holm"]) == min(1, np.nanmin(p) * np.sum(~np.isnan(p)))
    assert wrong <= 3  # 10 trials at 5 %: more than 3 in 0.1 % of all seeds


def test_lost_maps_are_worse_success(tmp_path: Path) -> None:
    def lose(seed: int, made: Tables) -> Tables:
        lost = (made["errors"]["aligner"] == "ransac") & (made["errors"]["iteration"] > 50)
        made["errors"].loc[lost, list(ERROR_COLUMNS)] = np.nan
        return made

    of = verdicts(compare(*two_sweeps(tmp_path, lose)).table)
    assert of[("success estimated", "ransac")] == WORSE
    assert of[("success estimated", "icp")] == SAME


def test_the_other_way_round_is_the_inverse(tmp_path: Path) -> None:
    a, b = two_sweeps(tmp_path, scaled(1.4, "icp", scatter=0.1))
    there, back = compare(a, b).table, compare(b, a).table
    ratio = there["scale"] == "ratio"
    np.testing.assert_allclose(there["change"][ratio], 1 / back["change"][ratio])
    np.testing.assert_allclose(there["change"][~ratio], -back["change"][~ratio], atol=1e-12)
    np.testing.assert_allclose(there["p"], back["p"])
    mirrored = there["verdict"].replace({BETTER: WORSE, WORSE: BETTER})
    assert mirrored.tolist() == back["verdict"].tolist()


def test_changes_of_less_than_a_percent_are_none(tmp_path: Path) -> None:
    found = compare(*two_sweeps(tmp_path, scaled(1.005, "ransac")))
    of = verdicts(found.table)
    assert of[("estimated error, m", "ransac")] == NOISE


def test_one_run_each_is_weak_and_says_so(tmp_path: Path) -> None:
    a = write_result(tmp_path / "a", 0, tables_of(0))
    b = write_result(tmp_path / "b", 0, scaled(2.0, "ransac", 0.1)(0, tables_of(0)))
    found = compare(a, b)
    assert found.unit == "maps of one run"
    assert any(note.startswith("weak: one run each") for note in found.notes)
    assert verdicts(found.table)[("estimated error, m", "ransac")] == WORSE


def test_few_runs_are_weak_too(tmp_path: Path) -> None:
    found = compare(*two_sweeps(tmp_path, lambda seed, made: made, seeds=3))
    assert any(note.startswith("weak: 3 runs") for note in found.notes)


def test_slower_is_told_but_never_fails(tmp_path: Path) -> None:
    def slower(seed: int, made: Tables) -> Tables:
        return made | {"aligner_timings": timings_of(seed, elapsed_s=5e-3)}

    found = compare(*two_sweeps(tmp_path, slower))
    assert verdicts(found.table)[("time, s", "icp")] == WORSE
    assert not found.worse
    assert any(note.startswith("times: all runs") for note in found.notes)


def test_runs_of_only_one_side_are_left_out(tmp_path: Path) -> None:
    a = write_sweep(tmp_path / "a", range(8))
    b = write_sweep(tmp_path / "b", range(2, 10))
    found = compare(a, b)
    assert found.n_runs == 6
    assert "left out: 2 runs of the first that the other has not (world seed 0, world seed 1)" in (
        found.notes
    )
    assert "left out: 2 runs of the second that the other has not (world seed 8, world seed 9)" in (
        found.notes
    )


def test_nothing_in_common_is_one_clear_line(tmp_path: Path) -> None:
    a = write_result(tmp_path / "a", 0, tables_of(0))
    other = write_result(tmp_path / "b", 0, tables_of(0), name="else")
    with pytest.raises(InputError, match=r"no run in common .*world seed 0, the second else seed"):
        compare(a, other)
    settings = [{"slam.particles": "50"}]
    with pytest.raises(InputError, match=r"slam\.particles=50"):
        compare(a, write_sweep(tmp_path / "c", (0,), settings))


def test_runs_are_matched_apart_from_a_setting_that_is_named(tmp_path: Path) -> None:
    """Compare a sweep of two values with a sweep of each value."""
    seeds = range(8)
    changed = {seed: scaled(0.5, "ransac")(seed, tables_of(seed)) for seed in seeds}
    few, many = ({"drive.frames": "9", "slam.particles": each} for each in ("50", "200"))
    a = write_sweep(tmp_path / "a", seeds, [few])
    b = write_sweep(tmp_path / "b", seeds, [many], made=changed)
    with pytest.raises(InputError, match="no run in common"):
        compare(a, b)
    found = compare(a, b, ["slam.particles"])
    assert found.n_runs == 8
    assert verdicts(found.table)[("estimated error, m", "ransac")] == BETTER
    assert verdicts(found.table)[("estimated error, m", "icp")] == SAME
    assert "matched apart from slam.particles: 50 in the first, 200 in the second" in found.notes
    plain = write_sweep(tmp_path / "c", seeds, [{"drive.frames": "9"}])
    plain = compare(plain, b, ["slam.particles"])
    assert plain.n_runs == 8
    assert "as the scenario says in the first, 200 in the second" in plain.notes[0]
    for unknown in ("slam.particle", "seed"):
        with pytest.raises(InputError, match=r"known: drive\.frames, slam\.particles$"):
            compare(a, b, [unknown])
    both = write_sweep(tmp_path / "d", seeds, [few, many])
    with pytest.raises(InputError, match=r"d: world seed 0 .* is there more than once"):
        compare(a, both, ["slam.particles"])


def test_two_values_within_one_sweep_are_compared_as_two_sweeps(tmp_path: Path) -> None:
    seeds, key = range(8), "slam.particles"
    changed = {seed: scaled(0.5, "ransac")(seed, tables_of(seed)) for seed in seeds}
    few, many = ({"drive.frames": "9", key: each} for each in ("50", "200"))
    apart = [
        write_sweep(tmp_path / "few", seeds, [few], file_a_run=True),
        write_sweep(tmp_path / "many", seeds, [many], made=changed),
    ]
    both = write_sweep(tmp_path / "both", seeds, [few, many], made=changed, file_a_run=True)
    for file in (tmp_path / "few").glob("*/world-*-0.parquet"):  # few particles, unchanged
        shutil.copy(file, both / file.parent.name)
    within, expected = compare_values(both, key, "50", "200"), compare(*apart, [key])
    pd.testing.assert_frame_equal(within.table, expected.table)
    assert within.notes == expected.notes
    assert (within.n_runs, within.unit) == (8, "run")
    row = within.table.set_index(["metric", "method"]).loc[("estimated error, m", "ransac")]
    assert (row["verdict"], row["n_better"], row["n_units"]) == (BETTER, 8, 8)
    back = compare_values(both, key, "200", "50").table.set_index(["metric", "method"])
    assert back.loc[("estimated error, m", "ransac"), "verdict"] == WORSE
    for wrong, message in (
        (
            ("slam.particle", "50", "200"),
            r"did not vary slam\.particle; it varied: slam\.particles",
        ),
        ((key, "50", "100"), r"no finished run has slam\.particles=100; there are: 50, 200$"),
        (("drive.frames", "9", "10"), r"did not vary drive\.frames"),
    ):
        with pytest.raises(InputError, match=message):
            compare_values(both, *wrong)
    with pytest.raises(InputError, match="is one run"):
        compare_values(write_result(tmp_path, 0, tables_of(0)), key, "50", "200")


def test_other_settings_under_the_same_name_are_told(tmp_path: Path) -> None:
    a = write_result(tmp_path / "a", 0, tables_of(0))
    b = write_result(tmp_path / "b", 0, tables_of(0))
    scenario = read_json(b / "scenario.json", "scenario")
    scenario["slam"] = {"filter": {"n_particles": 50}}
    write_json(b / "scenario.json", scenario)
    assert (
        "the scenarios differ: slam.filter.n_particles is absent in the first and 50 in the second"
        in compare(a, b).notes
    )


def test_tables_that_one_side_lacks_are_passed_over(tmp_path: Path) -> None:
    a = write_result(tmp_path / "a", 0, {"errors": errors_of(0)})
    b = write_result(tmp_path / "b", 0, tables_of(0))
    assert not compare(a, b).table["metric"].str.startswith("path").any()


def test_nees_is_better_the_nearer_to_one(tmp_path: Path) -> None:
    def fused(nees: float) -> Callable[[int, Tables], Tables]:
        def change(seed: int, made: Tables) -> Tables:
            rng = np.random.default_rng(seed)
            rows = {"robot_a": "R1", "robot_b": "R2", "degrees_of_freedom": 3, "true_pair": True}
            values = 3 * nees * rng.uniform(0.9, 1.1, 40)
            return made | {"fusion": pd.DataFrame(rows | {"nees_with_drift": values})}

        return change

    made = [
        {seed: fused(nees)(seed, tables_of(seed)) for seed in range(8)} for nees in (0.2, 2.0, 4.0)
    ]
    small, near, large = (
        write_sweep(tmp_path / str(i), range(8), made=tables) for i, tables in enumerate(made)
    )
    metric = ("fused NEES / dof", "")
    assert verdicts(compare(small, near).table)[metric] == BETTER
    assert verdicts(compare(large, near).table)[metric] == BETTER
    assert verdicts(compare(near, small).table)[metric] == WORSE


def test_each_fuser_is_compared_for_itself_by_its_last_map(tmp_path: Path) -> None:
    def fused(of_joint: float, every: int) -> Callable[[int, Tables], Tables]:
        def change(seed: int, made: Tables) -> Tables:
            rng = np.random.default_rng(seed)
            rows = [
                {"fuser": fuser, "iteration": k, "landmark_rmse_m": at_end if k == 40 else 9.0}
                for fuser, at_end in (("kalman", 0.2), ("joint", of_joint * rng.uniform(0.9, 1.1)))
                for k in range(0, 41, every)
            ]
            return made | {"fusers": pd.DataFrame(rows).assign(nees_per_dof=1.0)}

        return change

    a, b = (
        write_sweep(
            tmp_path / str(every),
            range(8),
            made={seed: fused(off_m, every)(seed, tables_of(seed)) for seed in range(8)},
        )
        for off_m, every in ((0.2, 10), (0.1, 20))
    )
    found = verdicts(compare(a, b).table)
    assert found["fused landmarks, m", "joint"] == BETTER
    assert found["fused landmarks, m", "kalman"] == SAME
    assert found["fuser's NEES / dof", "joint"] == SAME


def row(found, metric: str, method: str) -> dict:
    rows = found.table[(found.table["metric"] == metric) & (found.table["method"] == method)]
    (only,) = rows.to_dict("records")
    return only


def changed(seed: int, made: Tables) -> Tables:
    """RANSAC's refined errors are doubled; of one pair the second version has 2 true pairs."""
    errors = made["errors"]
    errors.loc[errors["aligner"] == "ransac", "refined_translation_error_m"] *= 2
    errors.loc[errors["robot_b"] == "R3", "n_true"] = 2
    made["map_fits"]["rmse_m"] *= 3
    return made


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> VersionComparison:
    return compare(*two_sweeps(tmp_path_factory.mktemp("versions"), changed, seeds=6))


def test_values_and_counts_are_those_of_the_tables(found: VersionComparison) -> None:
    over = row(found, "refined / oracle", "ransac")
    assert (over["a"], over["b"], over["change"]) == pytest.approx((1.01, 2.02, 2.0), rel=1e-6)
    # 6 runs of 2 pairs at 4 iterations; where either version has too few pairs it does not count
    assert row(found, "success refined", "icp")["n_rows"] == 6 * 2 * 4
    assert row(found, "estimated error, m", "icp")["n_rows"] == 6 * 4
    assert row(found, "true pairs", "")["n_rows"] == 6 * 4
    assert row(found, "landmark RMSE, m", "")["change"] == pytest.approx(3.0)
    assert row(found, "landmark RMSE, m", "")["n_rows"] == 6 * 3
    assert row(found, "fused RMSE, m", "")["n_rows"] == 6
    path = row(found, "path RMSE, m", "")
    assert (path["change"], path["n_rows"], path["verdict"]) == (1.0, 6 * 3, "identical")


def test_what_is_told_of_either_version_is_a_median_of_errors_and_a_mean_of_shares(
    found: VersionComparison,
) -> None:
    made = [tables_of(seed) for seed in range(6)]
    fits = pd.concat([each["map_fits"] for each in made])
    rmse_m = np.median(fits[fits["map"] != "fused"]["rmse_m"])
    landmarks = row(found, "landmark RMSE, m", "")
    assert (landmarks["a"], landmarks["b"]) == pytest.approx((rmse_m, 3 * rmse_m))
    errors = pd.concat([each["errors"] for each in made])
    of_icp = errors[errors["aligner"] == "icp"]
    right = (of_icp["refined_translation_error_m"] <= 0.5).mean()  # of as many answers a map
    assert 0.3 < right < 0.9
    assert row(found, "success refined", "icp")["a"] == pytest.approx(right)


def test_nees_of_fused_pairs_is_per_degree_of_freedom() -> None:
    """Each pair of robots gives the mean over its true pairs, in the plane or in space."""
    rows = {"robot_a": ["A"] * 3 + ["B"] * 2, "robot_b": "C", "run_id": "x"}
    rows |= {"nees_with_drift": [2.0, 4.0, 99.0, 6.0, 3.0], "degrees_of_freedom": [2, 2, 2, 3, 3]}
    fusion = pd.DataFrame(rows | {"true_pair": [True, True, False, True, True]})
    _, _, reduced = READ["fusion"]
    assert reduced(fusion)["nees"].tolist() == [1.5, 1.5]


def test_an_edge_is_false_only_where_it_was_used() -> None:
    _, _, reduced = READ["team_pairs"]
    wrong = {"accepted": True, "n_common": 40, "refined_translation_error_m": 9.0}
    pairs = pd.DataFrame([wrong | {"place": place} for place in ("confirmed", "contradicted")])
    found = reduced(pairs.assign(refined_rotation_error_rad=0.0, team_translation_error_m=1.0))
    assert (found["false"].tolist(), found["found"].tolist()) == ([1.0, 0.0], [0.0, 0.0])
