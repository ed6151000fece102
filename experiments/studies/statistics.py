"""Statistics over many runs: error bands, and all tables by name."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.evaluation import alignment_criteria
from experiments.evaluation.alignment_criteria import (
    ANSWERABLE_PAIRS,
    ERROR_COLUMNS,
    MAP_KEYS,
    NEEDED,
    OPTIONAL,
    RUN_KEYS,
    absolute_errors,
    has_common_ground,
    is_false_merge,
    is_used_by_team,
    right_refined,
    setting_columns,
    summarise_alignments,
    with_common_ground_at_any_time,
)
from experiments.evaluation.fused_landmarks import mean_nees_band
from experiments.evaluation.map_errors import last_fused
from experiments.evaluation.path_errors import STATISTICS
from experiments.studies import intervals
from experiments.studies.method_comparison import (
    LAST,
    compare_methods,
    oracle_ratios,
    success_rates,
)
from experiments.studies.run_tables import Runs
from mapfusion.align.alignment import Status
from mapfusion.geometry.numerics import generator

BAND = (0.1, 0.9)
_SIGNED = tuple(name for name in ERROR_COLUMNS if name.endswith("_rad"))
ROBOT_PAIR = ("robot_a", "robot_b")
TIME_GROUPS = 8


def error_bands(
    rows: pd.DataFrame, by: Sequence[str] = ROBOT_PAIR, absolute: bool = False
) -> pd.DataFrame:
    """Return median and 10-90 % band of errors by iteration.

    Bands are over repetitions for rows of `errors` and over runs for rows of `medians_of_run`. A
    row without an estimate counts as an infinite error. A signed rotation cannot be infinite: its
    band is NaN unless more than half of the rows have an estimate, and uses these rows only.

    Args:
        rows: rows of `errors` or `medians_of_run`.
        by: columns that separate groups, by default the robot pair.
        absolute: True to drop the sign of rotations.

    Returns:
        The columns of `by`, aligner, iteration, n_runs if rows have a run_id, and for each error
        NAME_low, NAME (the median) and NAME_high.
    """
    signed = () if absolute else _SIGNED
    rows = _infinite_where_missing(rows, signed)
    groups = rows.groupby([*by, "aligner", "iteration"], sort=False)
    parts = [groups["run_id"].nunique().rename("n_runs")] if "run_id" in rows else []
    for column in ERROR_COLUMNS:
        low, high = (groups[column].quantile(q) for q in BAND)
        found = [low.rename(f"{column}_low"), groups[column].median()]
        found += [high.rename(f"{column}_high")]
        if column in signed:
            parts += [each.where(_mostly_known(groups, column)) for each in found]
        else:  # pandas returns NaN for a quantile between two infinities
            parts += [each.fillna(np.inf) for each in found]
    return pd.concat(parts, axis=1).reset_index()


def medians_of_run(errors: pd.DataFrame) -> pd.DataFrame:
    """Reduce a run's repetitions to medians as `error_bands` does, with signed rotations.

    Bands of several runs are then over runs, and each run counts once.
    """
    keys = [name for name in RUN_KEYS if name in errors] + setting_columns(errors)
    errors = _infinite_where_missing(errors, _SIGNED)
    groups = errors.groupby([*keys, *MAP_KEYS, "aligner"], sort=False, dropna=False)
    medians = groups[list(ERROR_COLUMNS)].median()
    known = {name: medians[name].where(_mostly_known(groups, name)) for name in _SIGNED}
    parts = [medians.assign(**known), groups[list(alignment_criteria.COUNTS)].first()]
    return pd.concat(parts, axis=1).reset_index()


def _infinite_where_missing(rows: pd.DataFrame, signed: Sequence[str]) -> pd.DataFrame:
    """Return rows with infinite errors where there is no estimate, except in signed columns."""
    unsigned = [name for name in ERROR_COLUMNS if name not in signed]
    return rows.assign(**absolute_errors(rows, unsigned))


def _mostly_known(groups: Any, column: str) -> pd.Series:
    """Return True for each group in which more than half of the rows have a value."""
    return groups[column].count() > groups.size() / 2


def scarce_spans(rows: pd.DataFrame) -> list[tuple[float, float]]:
    """Return intervals of iterations in which most maps have too few true pairs for an answer.

    Rows are those of `errors` or `medians_of_run` of any method, as all methods get the same maps.
    Each interval extends half way to the next iteration.
    """
    maps = rows.drop_duplicates([name for name in ("run_id", *MAP_KEYS) if name in rows])
    scarce = (maps["n_true"] < ANSWERABLE_PAIRS).groupby(maps["iteration"]).mean() > 0.5
    at = scarce.index.to_numpy(dtype=np.float64)
    half = np.diff(at) / 2 if len(at) > 1 else np.array([0.5])
    start = at - np.concatenate([half[:1], half])[: len(at)]
    stop = at + np.concatenate([half, half[-1:]])[: len(at)]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], scarce.to_numpy().astype(int), [0]])))
    return [(float(start[first]), float(stop[end - 1])) for first, end in edges.reshape(-1, 2)]


def time_bands(
    timings: pd.DataFrame, column: str = "n_common", groups: int = TIME_GROUPS
) -> pd.DataFrame:
    """Return the time of one alignment by overlap, in groups of about equal size.

    Args:
        timings: rows of `aligner_timings`.
        column: n_common or n_correspondences; rows of equal value are in one group.
        groups: number of groups.

    Returns:
        aligner; COLUMN_low, COLUMN (the median) and COLUMN_high of the group; n_runs if rows have a
        run_id, n_maps; elapsed_low_s (10 %), elapsed_s (median) and elapsed_high_s (90 %).
    """
    timed = timings.dropna(subset="elapsed_s")
    rank = timed.groupby("aligner")[column].rank(pct=True)
    grouped = timed.assign(group=np.ceil(rank * groups)).groupby(["aligner", "group"])
    count, elapsed = grouped[column], grouped["elapsed_s"]
    found = {f"{column}_low": count.min(), column: count.median(), f"{column}_high": count.max()}
    found |= {"n_runs": grouped["run_id"].nunique()} if "run_id" in timed else {}
    found |= {"n_maps": grouped.size(), "elapsed_low_s": elapsed.quantile(BAND[0])}
    found |= {"elapsed_s": elapsed.median(), "elapsed_high_s": elapsed.quantile(BAND[1])}
    bands = pd.DataFrame(found).reset_index().drop(columns="group")
    return (
        bands.set_index("aligner")
        .loc[alignment_criteria.methods_in(timed, oracle=True)]
        .reset_index()
    )


FUSION_COLUMNS = ("nees_with_drift", "nees_without_drift", "degrees_of_freedom", "true_pair")
SMOOTHER_COLUMNS = ("path_rmse_m", "filter_over_smoother", "landmark_rmse_m", "gross_share")
SMOOTHER_COLUMNS += ("nees_per_dof", "coverage_95")
_FUSER_FIGURES = ("landmark_rmse_m", "over_better_filter", "nees_per_dof", "coverage_95")
_ADOPTED_FIGURES = ("landmark_rmse_m", "frame_nees_per_dof", "frame_coverage_95")
_ADOPTED_FIGURES += ("shared_share", "sent_kb")
ADOPTION_COLUMNS = ("robot", "iteration", "merged_path_rmse_m", "alone_merged_path_rmse_m")
ADOPTION_COLUMNS += _ADOPTED_FIGURES
_WORSE = 1.1  # times the error of the independent robot
FUSER_COLUMNS = ("fuser", "iteration", *_FUSER_FIGURES)
_PATH_KEYS = ["source", "quantity", "delta", "delta_unit"]


def path_summary(path_statistics: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Summarise path errors by source (final, online, odometry) and quantity (ATE, RPE).

    Returns:
        source, quantity, delta, delta_unit, n_runs, n_paths, the seven statistics that evo reports
        (medians over paths), and the interval of the median rmse (whole runs are resampled).
    """
    rows = []
    for keys, group_rows in path_statistics.groupby(_PATH_KEYS, sort=False, dropna=False):
        row = dict(zip(_PATH_KEYS, keys, strict=True))
        row |= {"n_runs": intervals.clusters_of(group_rows).n, "n_paths": len(group_rows)}
        rows.append(row | _path_medians(group_rows, rng))
    return pd.DataFrame(rows)


def _path_medians(path_rows: pd.DataFrame, rng: np.random.Generator) -> dict[str, float]:
    """Return the median of each of evo's statistics, and the interval of the median rmse."""
    runs = intervals.clusters_of(path_rows)
    _, low, high = intervals.median_interval(path_rows["rmse"].to_numpy(), runs, rng)
    return dict(path_rows[list(STATISTICS)].median()) | {"rmse_low": low, "rmse_high": high}


def nees_of_maps(landmark_nees: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Return the mean NEES per degree of freedom, before and after merging.

    Returns:
        One row per kind of landmark (see `evaluation.tables`): landmarks, n_runs, n_landmarks,
        nees_per_dof with its interval over runs, band_low and band_high (95 % band of the mean of
        n_landmarks independent landmarks), share_in_gate (0.95 if consistent) with its interval.
        Landmarks of one map drift together, so a mean outside the band does not prove that a
        single map is inconsistent. The interval over runs is valid.
    """
    rows = []
    rows_with_nees = landmark_nees[landmark_nees["n_landmarks"] > 0]
    for kind, kind_rows in rows_with_nees.groupby("landmarks", sort=False):
        runs, weight = (
            intervals.clusters_of(kind_rows),
            kind_rows["n_landmarks"].to_numpy(dtype=np.float64),
        )
        dof, share_in_gate = (
            kind_rows["degrees_of_freedom"].to_numpy(),
            kind_rows["share_in_gate"].to_numpy(),
        )
        per_dof = kind_rows["nees_mean"].to_numpy() / dof
        nees = intervals.weighted_mean_interval(per_dof, dof * weight, runs, rng)
        inside = intervals.weighted_mean_interval(share_in_gate, weight, runs, rng)
        # the degrees of freedom of a sum add up
        band = dict(zip(("band_low", "band_high"), mean_nees_band(dof @ weight, 1), strict=True))
        row = {"landmarks": kind, "n_runs": runs.n, "n_landmarks": int(weight.sum())}
        row |= nees.columns("nees_per_dof") | band | inside.columns("share_in_gate")
        rows.append(row)
    return pd.DataFrame(rows)


def nees_of_pairs(fusion: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Summarise the NEES of landmarks fused in pairs (table `fusion`), with and without s_drift.

    Only true pairs count. That table has no share in the gate, so it is NaN.
    """
    labels = {name: f"fused in pairs, {name[5:].replace('_', ' ')}" for name in FUSION_COLUMNS[:2]}
    true = fusion[fusion["true_pair"]].rename(columns=labels)
    keys, values = ["run_id", "degrees_of_freedom"], list(labels.values())
    rows = true.melt(keys, values, "landmarks", "nees_mean").dropna(subset="nees_mean")
    return nees_of_maps(rows.assign(n_landmarks=1, share_in_gate=np.nan), rng)


def alignment_nees(
    errors: pd.DataFrame, rng: np.random.Generator, maps: str = "FastSLAM's"
) -> pd.DataFrame:
    """Summarise `alignment_criteria.alignment_consistency` of accepted alignments by aligner.

    Args:
        errors: rows of `errors` or `smoothed_errors`.
        rng: random generator of the intervals.
        maps: name of the kind of maps, for a column.

    Returns:
        One row per aligner: aligner, maps, n_runs, n_maps, nees_per_dof (median) and coverage_90
        (share of true motions in the 90 % ellipsoid) with intervals over runs.
    """
    rows = []
    accepted = alignment_criteria.alignment_consistency(errors)
    for aligner, aligner_rows in accepted.groupby("aligner", sort=False):
        runs, inside = (
            intervals.clusters_of(aligner_rows),
            aligner_rows["inside"].to_numpy(dtype=np.float64),
        )
        row = {"aligner": aligner, "maps": maps, "n_runs": runs.n, "n_maps": len(aligner_rows)}
        row |= _medians(aligner_rows, ("nees_per_dof",), rng)
        coverage = intervals.weighted_mean_interval(inside, np.ones(len(aligner_rows)), runs, rng)
        rows.append(row | coverage.columns("coverage_90"))
    return pd.DataFrame(rows)


def smoother_summary(smoother: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Summarise the batch smoother beside the filter (table `smoother`): medians over robots.

    Returns:
        One row: n_runs, n_robots, and each numeric column with the interval of its median.
    """
    about = {"n_runs": intervals.clusters_of(smoother).n, "n_robots": len(smoother)}
    return pd.DataFrame([about | _medians(smoother, SMOOTHER_COLUMNS, rng)])


def adoption_summary(team_members: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Summarise robots that went on in a joint map (table `team_members`): medians over robots.

    Robots count at their last iteration.

    Returns:
        One row: n_runs, n_robots, n_adopting, `worse` (share of these whose path error since the
        merge is more than 1.1 times the independent robot's), and medians with their intervals.
    """
    last = team_members.sort_values("iteration").groupby(["run_id", "robot"]).tail(1)
    own = last[last["merged_path_rmse_m"].notna()]
    over_alone = own["merged_path_rmse_m"] / own["alone_merged_path_rmse_m"]
    own = own.assign(path_over_alone=over_alone)
    row: dict[str, Any] = {"n_runs": intervals.clusters_of(last).n, "n_robots": len(last)}
    row |= {"n_adopting": len(own)}
    row |= {"worse": float((over_alone > _WORSE).mean()) if len(own) else np.nan}
    return pd.DataFrame([row | _medians(own, ("path_over_alone", *_ADOPTED_FIGURES), rng)])


def fuser_summary(fusers: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Summarise fusers (table `fusers`): medians over runs, each at its last iteration.

    Returns:
        One row per fuser: fuser, n_runs, and each numeric column with the interval of its median.
    """
    rows = []
    for fuser, fuser_rows in last_fused(fusers).groupby("fuser", sort=False):
        row = {"fuser": fuser, "n_runs": intervals.clusters_of(fuser_rows).n}
        rows.append(row | _medians(fuser_rows, _FUSER_FIGURES, rng))
    return pd.DataFrame(rows)


def _medians(
    rows: pd.DataFrame, names: Sequence[str], rng: np.random.Generator
) -> dict[str, float]:
    """Return the median of each column with its interval over runs."""
    runs, found = intervals.clusters_of(rows), dict[str, float]()
    for name in names:
        found |= intervals.median_interval(rows[name].to_numpy(), runs, rng).columns(name)
    return found


_ERRORS = {
    "alone_m": "refined_translation_error_m",
    "alone_rad": "refined_rotation_error_rad",
    "team_m": "team_translation_error_m",
    "team_rad": "team_rotation_error_rad",
}


def team_paths(team: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Summarise the paths of each run's largest set of merged robots by source.

    Returns:
        source (final, online, odometry), n_runs, n_robots of n_team (sums over runs), evo's seven
        statistics of all their positions under one rigid fit (medians over runs), and the interval
        of the median rmse.
    """
    rows = []
    for source, source_rows in team[team["component"] == 1].groupby("source", sort=False):
        row: dict[str, Any] = {"source": source, "n_runs": len(source_rows)}
        row |= dict(source_rows[["n_robots", "n_team"]].sum())
        rows.append(row | _path_medians(source_rows, rng))
    return pd.DataFrame(rows)


def team_alignments(pairs: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Summarise the alignments of all pairs of robots.

    Returns:
        One row: n_runs, n_pairs, n_met (pairs with common ground), n_believed (pairs whose
        alignment is used); precision, the share of right ones among the used, and recall, the
        share of pairs with common ground whose alignment is right and used, with Wilson's
        intervals; medians of the errors of T_a_b over pairs in one map, aligned alone (alone_m,
        alone_rad) and by the whole team (team_m, team_rad), with intervals (whole runs are
        resampled).
    """
    used, met = is_used_by_team(pairs), has_common_ground(pairs)
    right = pd.Series(right_refined(pairs) & used)
    row: dict[str, Any] = {"n_runs": pairs["run_id"].nunique(), "n_pairs": len(pairs)}
    row |= {"n_met": int(met.sum()), "n_believed": int(used.sum())}
    row |= _share("precision", pairs[used], ~is_false_merge(pairs[used]))
    row |= _share("recall", pairs[met], right[met])
    placed = pairs[pairs["team_translation_error_m"].notna()]
    runs = intervals.clusters_of(placed)
    for name, column in _ERRORS.items():
        values = placed[column].abs().to_numpy()
        row |= intervals.median_interval(values, runs, rng).columns(name)
    return pd.DataFrame([row])


def _share(name: str, rows: pd.DataFrame, holds: pd.Series) -> dict[str, float]:
    """Return the share of rows for which `holds` is True, with its interval."""
    if rows.empty:
        return intervals.Interval(np.nan, np.nan, np.nan).columns(name)
    n = intervals.effective_trials(rows.groupby("run_id").size())
    share = float(holds.mean())
    low, high = map(float, intervals.wilson(share * n, n))
    return intervals.Interval(share, low, high).columns(name)


ALL_SCENARIOS = "(all)"
_FILE_NAMES = {
    "n_common": "success_by_overlap",
    "overlap_share": "success_by_overlap_share",
    "n_true": "success_by_true_pairs",
    "outlier_share": "success_by_outliers",
    "iteration": "success_by_iteration",
    LAST: "success_at_the_end",
}
_TIMING_COLUMNS = (*MAP_KEYS, "aligner", "n_correspondences", "n_common", "elapsed_s")
# Optional tables of runs: columns to read, name of the result, statistics, and name of their seed.
_FURTHER: dict[str, tuple[Any, str, Callable[..., pd.DataFrame], str]] = {
    "aligner_timings": (_TIMING_COLUMNS, "time_by_overlap", time_bands, ""),
    "path_statistics": (None, "paths", path_summary, "paths"),
    "team": (None, "team", team_paths, "team"),
    "team_pairs": (None, "team_pairs", team_alignments, "team_pairs"),
    "landmark_nees": (None, "nees", nees_of_maps, "nees"),
    "smoother": (SMOOTHER_COLUMNS, "smoother", smoother_summary, "smoother"),
    "fusers": (FUSER_COLUMNS, "fusers", fuser_summary, "fusers"),
    "team_members": (ADOPTION_COLUMNS, "adoption", adoption_summary, "adoption"),
    "fusion": (FUSION_COLUMNS, "nees", nees_of_pairs, "fusion"),
    "errors": (
        alignment_criteria.CONSISTENCY_COLUMNS,
        "alignment_nees",
        alignment_nees,
        "alignment_nees",
    ),
    "smoothed_errors": (
        alignment_criteria.CONSISTENCY_COLUMNS,
        "alignment_nees",
        partial(alignment_nees, maps="smoothed"),
        "alignment_nees smoothed",
    ),
}


class Summary(NamedTuple):
    """Statistics over runs.

    Attributes:
        n_runs: number of runs.
        n_worlds: number of scenarios and seeds.
        tables: tables by file name, with scenario and settings in front; "(all)" pools scenarios.
        run_medians: each run's medians over its repetitions, for figures 4 and 5.
        timings: rows of figure 6.
        missing: tables that no run has.
        failed: runs that failed, with their reason.
    """

    n_runs: int
    n_worlds: int
    tables: dict[str, pd.DataFrame]
    run_medians: pd.DataFrame
    timings: pd.DataFrame
    missing: tuple[str, ...]
    failed: pd.DataFrame

    @property
    def n_configurations(self) -> int:
        """Number of settings that sweeps tried (1 without sweeps)."""
        settings = setting_columns(self.run_medians)
        return len(self.run_medians[settings].drop_duplicates()) if settings else 1


def configurations(frame: pd.DataFrame) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """Yield labels and rows by scenario and settings, and of all scenarios if there are several."""
    names = ["scenario", *setting_columns(frame)]
    pooled = frame.assign(scenario=ALL_SCENARIOS)
    for each in [frame, pooled] if len(frame["scenario"].unique()) > 1 else [frame]:
        for keys, rows in each.groupby(names, sort=False, dropna=False):
            yield dict(zip(names, keys, strict=True)), rows


def summarise(runs: Runs) -> Summary:
    """Return all statistics of runs; tables that no run has are left out."""
    reduced = reduced_errors(runs)
    maps, medians = reduced.maps, reduced.medians
    made = {name: _each(maps, partial(success_rates, by=by)) for by, name in _FILE_NAMES.items()}
    made["error_over_oracle"] = _each(maps, oracle_ratios, "oracle")
    made["methods_compared"] = _each(maps, compare_methods, "paired")

    def bands(rows: pd.DataFrame) -> pd.DataFrame:
        is_pooled = (rows["scenario"] == ALL_SCENARIOS).all()
        return error_bands(with_common_ground_at_any_time(rows) if is_pooled else rows)

    made["errors_by_iteration"] = _each(medians, bands)
    timings = pd.DataFrame()
    absent = [table for table in _FURTHER if not runs.has(table)]
    missing = tuple(table for table in absent if table != "team_members")  # few have a team
    for table, (columns, name, made_of, seed) in _FURTHER.items():
        if table not in absent:
            rows = runs.read(table, columns)
            made[name] = _joined([made.get(name, pd.DataFrame()), _each(rows, made_of, seed)])
            timings = rows if table == "aligner_timings" else timings
    made = {name: table for name, table in made.items() if len(table)}
    worlds = runs.described[["scenario", "seed"]].drop_duplicates()
    return Summary(len(runs.described), len(worlds), made, medians, timings, missing, runs.failed)


class ReducedErrors(NamedTuple):
    """Errors of runs, reduced batch by batch to `summarise_alignments` and `medians_of_run`.

    `absent` are aligners whose package is not installed, which is not a failure.
    """

    maps: pd.DataFrame
    medians: pd.DataFrame
    absent: list[str]


def reduced_errors(runs: Runs) -> ReducedErrors:
    """Read and reduce the errors of runs, for statistics, figures and reports."""
    maps, medians, every = [], [], []
    for whole in runs.batches("errors", NEEDED, ("status", *OPTIONAL)):
        every += whole["aligner"].unique().tolist()
        errors = whole[whole["status"] != Status.ABSENT]
        if len(errors):
            maps.append(summarise_alignments(errors))
            medians.append(medians_of_run(errors))
    if not maps:  # single robots
        nothing = pd.DataFrame(columns=["run_id", "scenario", "aligner"])
        return ReducedErrors(nothing, nothing, list(dict.fromkeys(every)))
    joined = with_overlap_share(pd.concat(maps, ignore_index=True), runs)
    absent = [name for name in dict.fromkeys(every) if name not in set(joined["aligner"])]
    return ReducedErrors(joined, pd.concat(medians, ignore_index=True), absent)


def with_overlap_share(maps: pd.DataFrame, runs: Runs) -> pd.DataFrame:
    """Add overlap_share to alignment summaries: n_common over the landmarks of the smaller map.

    It is NaN if the runs have no table `robots`. A robot whose log has ended keeps its last map.
    """
    if not runs.has("robots"):
        return maps.assign(overlap_share=np.nan)
    iterations, parts = np.unique(maps["iteration"]), []
    for rows in runs.batches("robots", ["robot", "iteration", "n_landmarks"]):
        sizes = rows.pivot_table("n_landmarks", "iteration", ["run_id", "robot"]).ffill()
        at = sizes.reindex(pd.Index(iterations, name="iteration"), method="ffill")
        parts.append(at.melt(ignore_index=False).set_index(["run_id", "robot"], append=True))
    sizes = pd.concat(parts)["value"]
    places = (maps[["iteration", "run_id", robot]] for robot in ROBOT_PAIR)
    a, b = (sizes.reindex(pd.MultiIndex.from_frame(own)).to_numpy() for own in places)
    smaller = pd.Series(np.fmin(a, b), maps.index)
    # an empty map has nothing in common with another
    share = (maps["n_common"] / smaller.where(smaller > 0)).where(smaller != 0, 0.0)
    return maps.assign(overlap_share=share)


def _each(
    frame: pd.DataFrame, made_of: Callable[..., pd.DataFrame], seed: str = ""
) -> pd.DataFrame:
    """Concatenate the tables of all configurations, with their labels in front.

    A statistic with a seed gets its own random generator for each configuration.
    """
    parts = []
    for labels, rows in configurations(frame):
        drawn = [generator(0, seed, *map(str, labels.values()))] if seed else []
        part = made_of(rows, *drawn)
        for place, (name, value) in enumerate(labels.items()):
            part.insert(place, name, value)
        parts.append(part)
    return _joined(parts)


def _joined(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Concatenate tables without the empty ones, whose columns would turn counts into floats."""
    parts = [part for part in parts if len(part)]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
