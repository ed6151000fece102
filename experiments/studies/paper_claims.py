"""Claims of the paper (sections 4 to 7, figures 1 to 10), each compared with measured values.

A claim has a measure, which is one number per run, and the range of values that confirms it. The
value of a claim is the median over runs, with a bootstrap interval over whole runs. The claim is
confirmed if the whole interval lies in the range, refuted if all of it lies outside, and partly
confirmed otherwise. For a single run there is no interval, and the value decides.

Measures read the tables of results only.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
import scipy

from experiments.evaluation.alignment_criteria import (
    MERGEABLE_PAIRS,
    RIGHT_WITHIN_M,
    answerable,
    at_last_iteration,
    has_common_ground,
    mergeable,
    merged_robots,
    repetition_spread_m,
    right_refined,
    summarise_alignments,
)
from experiments.evaluation.loop_closures import WINDOW_FRAMES, LoopClosure, loop_closures
from experiments.evaluation.map_errors import last_fused
from experiments.pipeline.tables import FLOAT, INT, TEXT, fields
from experiments.studies.intervals import RUN, Clusters, median_interval
from experiments.studies.run_tables import Runs
from mapfusion.errors import InputError
from mapfusion.files import COVARIANCE_FIELDS, POSITION_FIELDS, schema
from mapfusion.geometry.numerics import generator

SCENARIOS = ("paper_as_printed", "paper")
ALIGNERS = ("ransac", "svd", "icp", "impicp")  # of the paper
PAPERS_FUSER, AS_PRINTED = "kalman", "kalman_as_printed"


class Verdict(StrEnum):
    """Result of the comparison of a claim with its measured value."""

    CONFIRMED = "confirmed"
    PARTLY = "partly"
    REFUTED = "refuted"
    UNKNOWN = "not measured"


class NotMeasured(Exception):  # noqa: N818  # no error: the run has no such data
    """Signal that a run lacks the data of a measure."""


class TablesOfRun:
    """Tables of one run by name.

    Args:
        rows: tables of several runs by name.
        run_id: the run.
    """

    def __init__(self, rows: Mapping[str, pd.DataFrame], run_id: str) -> None:
        self._rows, self._run_id = rows, run_id

    def __call__(self, name: str) -> pd.DataFrame:
        """Return the rows of a table; raise NotMeasured if there are none."""
        if name not in self._rows:
            raise NotMeasured(name)
        own = self._rows[name][self._rows[name]["run_id"] == self._run_id]
        if own.empty:
            raise NotMeasured(name)
        return own

    @cached_property
    def maps(self) -> pd.DataFrame:
        """Alignments by pair of maps: medians over repetitions, infinite without an estimate."""
        return summarise_alignments(self("errors"))

    def errors_of(self, aligner: str, column: str = "translation_error_m") -> pd.Series:
        """Return the errors of one aligner on all pairs of maps that it can align."""
        maps = answerable(self.maps)
        return maps.loc[maps["aligner"] == aligner, column]


Measure = Callable[[TablesOfRun], float]


@dataclass(frozen=True)
class Claim:
    """Claim of the paper.

    Attributes:
        name: short name, for scripts.
        where: section and figure of the paper.
        text: the claim.
        measure: what is measured, with the definition.
        unit: unit of the value; empty for a number.
        confirms: smallest and largest value that confirm the claim.
        of_run: computes the value of a run.
        why: explanation of the result.
    """

    name: str
    where: str
    text: str
    measure: str
    unit: str
    confirms: tuple[float, float]
    of_run: Measure
    why: str


def _ratio(over: float, under: float) -> float:
    """Return a ratio of two errors; NaN if it is undefined."""
    if not under > 0 or (math.isinf(over) and math.isinf(under)):
        return math.nan
    return over / under


def _known_median(values: Sequence[float]) -> float:
    """Return the median of the values that are not NaN; NaN if there are none."""
    return float(pd.Series(values, dtype=np.float64).median())


def _rank_correlation(x: pd.Series, y: pd.Series) -> float:
    """Return Spearman's rank correlation; NaN if one of the two is constant."""
    a, b = x.rank().to_numpy(), y.rank().to_numpy()
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    return float(np.corrcoef(a, b)[0, 1])


CLAIMS: list[Claim] = []


def _claim(
    name: str,
    where: str,
    text: str,
    measure: str,
    unit: str,
    confirms: tuple[float, float],
    why: str,
) -> Callable[[Measure], Measure]:
    """Add a claim to CLAIMS whose value the decorated function computes; see `Claim`."""

    def add(of_run: Measure) -> Measure:
        CLAIMS.append(Claim(name, where, text, measure, unit, confirms, of_run, why))
        return of_run

    return add


_INF = math.inf


# Section 4: map building


def _closures(of: TablesOfRun) -> list[LoopClosure]:
    return loop_closures(of("sightings"), of("robots"))


_FIRST_FRAMES = 20  # of the run: the first metres


def _sigma_m(rows: pd.DataFrame) -> pd.Series:
    """Return the root of the trace of the landmarks' covariances."""
    return rows[["cov_xx_m2", "cov_yy_m2", "cov_zz_m2"]].sum(axis="columns").pow(0.5)


@_claim(
    "tracks",
    "4, figure 1",
    "Harris points with U-SURF descriptors are tracked over consecutive images.",
    "share of observations that continue a track",
    "",
    (0.5, 1.0),
    "Most corners stay in view from one frame to the next.",
)
def _tracked_share(of: TablesOfRun) -> float:
    sightings = of("sightings")
    return float(sightings["n_tracked"].sum() / sightings["n_observed"].sum())


@_claim(
    "growth",
    "4, figure 3",
    "All particles start in one place and spread while the robot moves.",
    "median spread (RMS distance of the particles from their mean) before the first loop "
    f"closure over that of the first {_FIRST_FRAMES} frames, median over robots",
    "",
    (1.0, _INF),
    "Each motion adds noise, and new landmarks do not correct the pose.",
)
def _growth(of: TablesOfRun) -> float:
    """Return the spread before the first loop closure over that of the first frames."""
    first_of: dict[str, int] = {}
    for closure in _closures(of):
        first_of.setdefault(closure.robot, closure.iteration)
    ratios = []
    for robot, rows in of("robots").groupby("robot"):
        k, spread = rows["iteration"], rows["spread_m"]
        end = first_of.get(str(robot), int(k.max()))
        later = spread[(k > _FIRST_FRAMES) & (k < end)].median()
        ratios.append(_ratio(later, spread[k.between(1, _FIRST_FRAMES)].median()))
    return _known_median(ratios)


@_claim(
    "closure",
    "4, figures 2 and 3",
    "The particles draw together when the robot closes a loop.",
    f"median spread in the {WINDOW_FRAMES} frames after a loop closure over that in the "
    f"{WINDOW_FRAMES} before it, median over loop closures",
    "",
    (0.0, 1.0),
    "Landmarks of the first visit correct the pose. Closures are few, and resampling makes "
    "the spread of single frames vary.",
)
def _fall(of: TablesOfRun) -> float:
    return _known_median([_ratio(each.after_m, each.before_m) for each in _closures(of)])


@_claim(
    "particles",
    "4",
    "200 particles represent the pose of a robot.",
    "effective sample size, median over frames and robots",
    "",
    (10.0, 200.0),
    "The particles must not spread much wider than the likelihood of eq. 10; the scenario's "
    "noise is chosen for that.",
)
def _effective_particles(of: TablesOfRun) -> float:
    return float(of("robots")["effective_sample_size"].median())


@_claim(
    "sightings",
    "4, figure 2",
    "A landmark is more certain the more often the robot saw it.",
    "rank correlation of the number of sightings and sigma (root of the trace of the "
    "covariance), median over the robots' last maps",
    "",
    (-1.0, 0.0),
    "Each sighting reduces the covariance (eq. 9).",
)
def _sigma_by_sightings(of: TablesOfRun) -> float:
    maps = of("landmarks").groupby("robot")
    return float(np.median([_rank_correlation(own["count"], _sigma_m(own)) for _, own in maps]))


@_claim(
    "distance",
    "4, figure 2",
    "A landmark is less certain the farther away it was seen.",
    "rank correlation of the distance to the nearest pose of the path and sigma, median over "
    "the robots' last maps",
    "",
    (0.0, 1.0),
    "The error of stereo depth grows with the square of the distance. The printed filter needs "
    "more noise than that, equal at all distances, so that the number of sightings decides.",
)
def _sigma_by_distance(of: TablesOfRun) -> float:
    paths, correlations = of("paths"), []
    for robot, own in of("landmarks").groupby("robot"):
        path = paths.loc[paths["robot"] == robot, ["final_x_m", "final_y_m"]].to_numpy()
        nearest_m, _ = scipy.spatial.KDTree(path).query(own[POSITION_FIELDS[:2]].to_numpy())
        correlations.append(_rank_correlation(pd.Series(nearest_m), _sigma_m(own)))
    return float(np.median(correlations))


# Section 5: alignment


def _median_error(aligner: str, column: str = "translation_error_m") -> Measure:
    return lambda of: float(of.errors_of(aligner, column).abs().median())


def _error_over(first: str, second: str) -> Measure:
    return lambda of: _ratio(of.errors_of(first).median(), of.errors_of(second).median())


def _change(aligner: str, first: int, last: int) -> Measure:
    """Return the error at the last iteration over that at the first, medians over robot pairs."""

    def of_run(of: TablesOfRun) -> float:
        rows = of.maps[of.maps["aligner"] == aligner]
        errors = rows.groupby("iteration")["translation_error_m"].median()
        iterations = errors.index.to_numpy()
        before, after = (errors.iloc[int(np.argmin(np.abs(iterations - k)))] for k in (first, last))
        return _ratio(float(after), float(before))

    return of_run


def _worst_answer(aligner: str, column: str) -> Measure:
    """Return the largest error over iterations of the median pair that has an answer."""

    def of_run(of: TablesOfRun) -> float:
        rows = of.maps[of.maps["aligner"] == aligner]
        rows = rows[np.isfinite(rows[column])]
        return float(rows[column].abs().groupby(rows["iteration"]).median().max())

    return of_run


def _error_by_true_pairs(aligner: str) -> Measure:
    def of_run(of: TablesOfRun) -> float:
        rows = of.maps[of.maps["aligner"] == aligner]
        return _rank_correlation(rows["n_true"], rows["translation_error_m"])

    return of_run


def _scatter(aligner: str) -> Measure:
    def of_run(of: TablesOfRun) -> float:
        rows = answerable(of("errors"))
        return repetition_spread_m(rows[rows["aligner"] == aligner])

    return of_run


@_claim(
    "correspondences",
    "5, figure 7",
    "Descriptors identify the common landmarks of two maps.",
    "share of true pairs among the correspondences of the last maps, median over robot pairs",
    "",
    (0.5, 1.0),
    "U-SURF descriptors of the same corner agree if both robots saw it from similar places.",
)
def _true_share(of: TablesOfRun) -> float:
    last = at_last_iteration(of.maps).drop_duplicates(["robot_a", "robot_b"])
    return float((last["n_true"] / last["n_correspondences"]).median())


_claim(
    "ransac_translation",
    "5, figure 4",
    "RANSAC's translation error is very close to zero.",
    "median error over maps with 3 or more true pairs, before refinement",
    "m",
    (0.0, 0.1),
    "RANSAC uses only the pairs that agree. The rest of its error is the drift of the maps.",
)(_median_error("ransac"))


_claim(
    "ransac_rotation",
    "5, figure 5",
    "RANSAC's rotation error is very close to zero.",
    "median absolute error over the same maps",
    "rad",
    (0.0, 0.01),
    "RANSAC uses only the pairs that agree.",
)(_median_error("ransac", "rotation_error_rad"))


@_claim(
    "ransac_always",
    "5, figure 4",
    "RANSAC is accurate at every iteration.",
    f"largest error over maps with {MERGEABLE_PAIRS} or more true pairs",
    "m",
    (0.0, 0.25),
    "With enough true pairs, the largest set that agrees is the right one.",
)
def _largest_ransac_error(of: TablesOfRun) -> float:
    maps = mergeable(of.maps)
    return float(maps.loc[maps["aligner"] == "ransac", "translation_error_m"].max())


@_claim(
    "ransac_robust",
    "5",
    "RANSAC does not depend on the percentage of common landmarks.",
    f"median error of the third of the maps with most false pairs over that of the third with "
    f"fewest, of maps with {MERGEABLE_PAIRS} or more true pairs",
    "",
    (0.5, 2.0),
    "False pairs are left out. Maps with many false pairs also have few true ones, so that "
    "chance averages out less.",
)
def _ransac_by_false_pairs(of: TablesOfRun) -> float:
    maps = mergeable(of.maps)
    own = maps[maps["aligner"] == "ransac"]
    low, high = own["outlier_share"].quantile([1 / 3, 2 / 3])
    error, share = own["translation_error_m"], own["outlier_share"]
    return _ratio(error[share >= high].median(), error[share <= low].median())


_claim(
    "svd_acceptable",
    "5, figure 4",
    "SVD obtains acceptable solutions.",
    f"median error, as RANSAC's; acceptable up to {RIGHT_WITHIN_M:g} m, which refinement can "
    "correct",
    "m",
    (0.0, RIGHT_WITHIN_M),
    "Algorithm 1 gives false pairs full weight, and T may shear and scale.",
)(_median_error("svd"))


_claim(
    "svd_below_ransac",
    "5, figure 4",
    "SVD is less accurate than RANSAC.",
    "median error of SVD over that of RANSAC",
    "",
    (1.0, _INF),
    "SVD uses the false pairs, too.",
)(_error_over("svd", "ransac"))


_claim(
    "svd_before_icp",
    "5, figure 4",
    "SVD is more accurate than ICP.",
    "median error of SVD over that of ICP",
    "",
    (0.0, 1.0),
    "SVD needs nearly clean correspondences. ICP needs them for its start only, and loses "
    "where most of them are false (see the figure).",
)(_error_over("svd", "icp"))


_claim(
    "svd_before_impicp",
    "5, figure 4",
    "SVD is more accurate than ImpICP.",
    "median error of SVD over that of ImpICP",
    "",
    (0.0, 1.0),
    "As for ICP. The paper does not define ImpICP; ours starts from the best of three starts.",
)(_error_over("svd", "impicp"))


_claim(
    "icp_translation",
    "5, figure 4",
    "ICP's translation error rises to about 4 m.",
    "largest error over iterations, median over the robot pairs with an answer",
    "m",
    (2.0, 8.0),
    "A start from false pairs ends in another minimum, metres away. The size depends on the "
    "building.",
)(_worst_answer("icp", "translation_error_m"))


_claim(
    "impicp_translation",
    "5, figure 4",
    "ImpICP's translation error rises to about 4 m.",
    "as for ICP",
    "m",
    (2.0, 8.0),
    "As for ICP; better starts are found while most correspondences are true.",
)(_worst_answer("impicp", "translation_error_m"))


_claim(
    "icp_rotation",
    "5, figure 5",
    "ICP's rotation error rises to about 0.2 rad.",
    "largest absolute error over iterations, median over the robot pairs with an answer",
    "rad",
    (0.1, 0.4),
    "A wrong start may have any angle.",
)(_worst_answer("icp", "rotation_error_rad"))


_claim(
    "icp_falls",
    "5, figure 4",
    "ICP's error falls from k = 200 to k = 600.",
    "median error over robot pairs at k = 600 over that at k = 200; no answer is infinite",
    "",
    (0.0, 1.0),
    "The common ground grows, and with it the share of true pairs.",
)(_change("icp", 200, 600))


_claim(
    "impicp_falls",
    "5, figure 4",
    "ImpICP's error falls from k = 200 to k = 600.",
    "as for ICP",
    "",
    (0.0, 1.0),
    "The common ground grows, and with it the share of true pairs.",
)(_change("impicp", 200, 600))


_claim(
    "icp_rises",
    "5, figure 4",
    "The error is larger around k = 1000.",
    "median error of ICP over robot pairs at k = 1000 over that at k = 600",
    "",
    (1.0, _INF),
    "It depends on the routes: which robots enter rooms that the others never see.",
)(_change("icp", 600, 1000))


_claim(
    "icp_by_common_ground",
    "5",
    "More correspondences give better estimates: ICP.",
    "rank correlation of the number of true pairs and the error",
    "",
    (-1.0, 0.0),
    "More true pairs make a good start more probable.",
)(_error_by_true_pairs("icp"))


_claim(
    "impicp_by_common_ground",
    "5",
    "More correspondences give better estimates: ImpICP.",
    "as for ICP",
    "",
    (-1.0, 0.0),
    "More true pairs make a good start more probable.",
)(_error_by_true_pairs("impicp"))


_claim(
    "icp_scatters",
    "5",
    "ICP's results have a high variance.",
    "range of the middle 80 % of the errors of 20 repetitions on the same maps, median",
    "m",
    (RIGHT_WITHIN_M, _INF),
    "The start is drawn at random.",
)(_scatter("icp"))


_claim(
    "impicp_scatters",
    "5",
    "ImpICP's results have a high variance.",
    "as for ICP",
    "m",
    (RIGHT_WITHIN_M, _INF),
    "The best of a few starts is nearly always a good one while most pairs are true.",
)(_scatter("impicp"))


@_claim(
    "times_grow",
    "5, figure 6",
    "The time of an alignment grows with the overlap of the maps.",
    "rank correlation of the number of common landmarks and the time, mean over the four methods",
    "",
    (0.0, 1.0),
    "More common landmarks come with more correspondences and larger maps.",
)
def _time_by_overlap(of: TablesOfRun) -> float:
    timed = of("aligner_timings")
    own = (timed[timed["aligner"] == name] for name in ALIGNERS)
    return float(np.mean([_rank_correlation(each["n_common"], each["elapsed_s"]) for each in own]))


@_claim(
    "times_alike",
    "5, figure 6",
    "The times of the methods are very similar.",
    "median time of the slowest method over that of the fastest",
    "",
    (1.0, 3.0),
    "ICP searches the nearest landmark of each landmark in every round; the paper's maps were "
    "smaller.",
)
def _slowest_over_fastest(of: TablesOfRun) -> float:
    timed = of("aligner_timings")
    times = timed[timed["aligner"].isin(ALIGNERS)].groupby("aligner")["elapsed_s"].median()
    return _ratio(times.max(), times.min())


@_claim(
    "refinement",
    "5",
    "The least squares after the alignment eliminates outliers.",
    f"share of true pairs among the refined inliers of RANSAC, median over maps with "
    f"{MERGEABLE_PAIRS} or more true pairs",
    "",
    (0.95, 1.0),
    "Few false pairs lie within the gate around a good estimate.",
)
def _refined_precision(of: TablesOfRun) -> float:
    rows = mergeable(of("errors"))
    return float(rows.loc[rows["aligner"] == "ransac", "precision"].median())


@_claim(
    "ransac_first",
    "5, 7",
    "RANSAC is the most suitable of the four methods.",
    "smallest median error of the others over RANSAC's",
    "",
    (1.0, _INF),
    "Only RANSAC tells true pairs from false ones.",
)
def _lead(of: TablesOfRun) -> float:
    others = [of.errors_of(name).median() for name in ALIGNERS if name != "ransac"]
    return _ratio(min(others), of.errors_of("ransac").median())


# Section 6: merging


def _areas_of_parents_and_fused(of: TablesOfRun) -> pd.DataFrame:
    """Return the areas of the ellipses (in plan, without pi) of fused landmarks: a, b and fused.

    Covariances have the drift of the maps added, as the fusion used them.
    """
    fused, maps = of("fused"), of("landmarks").set_index(["robot", "landmark"])
    drift_m2 = of("fused_motions").set_index("robot")["drift_sigma_m"] ** 2
    both = fused[fused["n_parents"] == 2]
    areas = {"fused": _area_m2(both, 0.0)}
    for side in "ab":
        robot = both[f"robot_{side}"]
        rows = maps.loc[list(zip(robot, both[f"landmark_{side}"], strict=True))]
        areas[side] = _area_m2(rows, drift_m2[robot].to_numpy())
    return pd.DataFrame(areas)


def _area_m2(rows: pd.DataFrame, drift_m2: Any) -> np.ndarray:
    xx, xy, _, yy, *_ = (rows[name].to_numpy() for name in COVARIANCE_FIELDS)
    return np.sqrt(np.maximum((xx + drift_m2) * (yy + drift_m2) - xy**2, 0.0))


def _of_fuser(fuser: str, column: str) -> Measure:
    def of_run(of: TablesOfRun) -> float:
        last = last_fused(of("fusers"))
        own = last.loc[last["fuser"] == fuser, column]
        return float(own.iloc[0]) if len(own) else math.nan

    return of_run


@_claim(
    "two_ellipses",
    "6, figure 8",
    "A landmark has different uncertainties in the maps of two robots.",
    "area of the larger of the two ellipses over that of the smaller, median over common landmarks",
    "",
    (1.1, _INF),
    "The robots see a landmark from different distances and differently often.",
)
def _larger_over_smaller(of: TablesOfRun) -> float:
    areas = _areas_of_parents_and_fused(of)[["a", "b"]]
    return float((areas.max(axis=1) / areas.min(axis=1)).median())


@_claim(
    "smaller_ellipses",
    "6, 7, figure 9",
    "Fused landmarks are less uncertain than the robots' own.",
    "area of the fused ellipse over that of the smaller ellipse of the two parents, median",
    "",
    (0.0, 1.0),
    "Eq. 14 always gives a smaller covariance; this is algebra and no result.",
)
def _fused_over_smaller(of: TablesOfRun) -> float:
    areas = _areas_of_parents_and_fused(of)
    return float((areas["fused"] / areas[["a", "b"]].min(axis=1)).median())


_claim(
    "smaller_errors",
    "6, 7",
    "The fused map is better than the local maps.",
    f"error of common landmarks in the map of `{PAPERS_FUSER}` over that in the better of the "
    "two robots' maps, after a rigid fit of each",
    "",
    (0.0, 1.0),
    "Independent errors average out, the drift of each map does not.",
)(_of_fuser(PAPERS_FUSER, "over_better_parent"))


_claim(
    "ellipses_hold",
    "6",
    "Covariances represent the uncertainty of the fused landmarks.",
    f"share of true points in the 95 % ellipses of `{PAPERS_FUSER}`, in the frame of its map",
    "",
    (0.9, 1.0),
    "The covariance of a landmark holds for one path. The error of the path is not in it.",
)(_of_fuser(PAPERS_FUSER, "frame_coverage_95"))


@_claim(
    "eq_13",
    "6, eq. 13",
    "Eq. 13 as printed gives the fused landmark.",
    f"landmark error of `{AS_PRINTED}` over that of `{PAPERS_FUSER}` (RMS, in the frame of the "
    "map)",
    "",
    (0.0, 1.0),
    "The sign is wrong: the fused landmark moves away from the second one.",
)
def _printed_over_corrected(of: TablesOfRun) -> float:
    printed, corrected = (
        _of_fuser(name, "landmark_rmse_m")(of) for name in (AS_PRINTED, PAPERS_FUSER)
    )
    return _ratio(printed, corrected)


@_claim(
    "one_map",
    "6, figure 10",
    "The local maps are merged into one global map.",
    "share of the robots whose maps are in the fused map at the end",
    "",
    (1.0, 1.0),
    "All robots share ground.",
)
def _merged_share(of: TablesOfRun) -> float:
    placed = of("fused_motions")["tx_m"]
    return merged_robots(placed) / len(placed)


# Section 7: conclusion


@_claim(
    "no_start_poses",
    "7",
    "The relative positions of the robots are not needed.",
    f"share of robot pairs with common ground whose refined alignment by RANSAC is right at "
    f"the end (within {RIGHT_WITHIN_M:g} m)",
    "",
    (0.95, 1.0),
    "The correspondences determine the alignment.",
)
def _right_at_the_end(of: TablesOfRun) -> float:
    errors = of("errors")
    last = at_last_iteration(errors[errors["aligner"] == "ransac"])
    last = last[has_common_ground(last)]
    return float(right_refined(last).mean())


# Where the paper leaves something open or contradicts itself.
READINGS = (
    "Eq. 10 weighs one observation; the weight of a frame is the product over its observations. "
    "An observation without a match has the density of a match at the gate.",
    "Algorithm 1 works on homogeneous points: (x, y, z, 1) in `paper_as_printed`, which gives the "
    "4x4 matrix of eq. 11, and (x, y, 1) in `paper`. Its result is no rotation: theta is that of "
    "the nearest rotation of its block of x and y, and the translation is its last column.",
    "The paper says of ImpICP only that it is an ad hoc change of ICP that makes a good estimate "
    "more probable. Ours draws three pairs of correspondences from the quarter with the smallest "
    "descriptor distances, and starts from the one whose motion brings the maps closest.",
    "ICP starts from the motion of two random correspondences; the paper does not say where its "
    "ICP starts.",
    "Theta is counter-clockwise here; the matrix of eq. 11 turns by -theta.",
    "Eq. 13 is printed with L_i - L_j. `kalman_as_printed` keeps that sign, `kalman` uses L_j - "
    "L_i.",
    "The robots of the paper carry a laser, which it does not use; ours have none.",
)
_TABLES = ("errors", "robots", "sightings", "fusers", "fused_motions", "aligner_timings")
_TABLES += ("landmarks", "paths", "fused")
# One row per claim, scenario and renderer.
VALUES = schema(
    "paper.claims",
    1,
    fields(
        **dict.fromkeys(("name", "where", "claim", "measure", "unit"), TEXT),
        **dict.fromkeys(("confirms_from", "confirms_to"), FLOAT),
        **dict.fromkeys(("scenario", "renderer"), TEXT),
        n_runs=INT,
        **dict.fromkeys(("value", "value_low", "value_high"), FLOAT),
        **dict.fromkeys(("verdict", "why"), TEXT),
    ),
)


def verdict(claim: Claim, value: float, low: float, high: float) -> Verdict:
    """Compare a value and its interval with the range that confirms a claim.

    Args:
        claim: the claim.
        value: measured value; NaN if it was not measured.
        low: lower end of the interval; NaN if there is no interval.
        high: upper end of the interval.
    """
    if math.isnan(value):
        return Verdict.UNKNOWN
    low, high = (value, value) if math.isnan(low) or math.isnan(high) else (low, high)
    first, last = claim.confirms
    if first <= low and high <= last:
        return Verdict.CONFIRMED
    return Verdict.REFUTED if high < first or low > last else Verdict.PARTLY


def compare_with_paper(sources: Sequence[Runs]) -> pd.DataFrame:
    """Return the table of claims (VALUES) for the runs of the scenarios in SCENARIOS.

    Runs of other scenarios are left out.

    Raises:
        InputError: a run of one scenario, seed and renderer was given twice.
    """
    groups: dict[tuple[str, str], dict[str, TablesOfRun]] = {}
    for runs in sources:
        described = runs.described[runs.described["scenario"].isin(SCENARIOS)]
        rows = {name: runs.read(name) for name in _TABLES if len(described) and runs.has(name)}
        for run_id, scenario in zip(described["run_id"], described["scenario"], strict=True):
            renderer = runs.renderers[run_id]
            group = groups.setdefault((scenario, renderer), {})
            if run_id in group:
                raise InputError(f"run {run_id}: was given twice with the renderer {renderer}")
            group[run_id] = TablesOfRun(rows, run_id)
    ordered = sorted(groups, key=lambda key: (SCENARIOS.index(key[0]), key[1]))
    found = []
    for claim in CLAIMS:
        about = {"name": claim.name, "where": claim.where, "claim": claim.text}
        about |= {"measure": claim.measure, "unit": claim.unit, "why": claim.why}
        about |= dict(zip(("confirms_from", "confirms_to"), claim.confirms, strict=True))
        for scenario, renderer in ordered:
            values = []
            for of in groups[scenario, renderer].values():
                with suppress(NotMeasured):
                    values.append(claim.of_run(of))
            known = np.array(values, np.float64)
            known = known[~np.isnan(known)]
            clusters = Clusters(np.arange(len(known)), len(known), RUN)
            interval = median_interval(known, clusters, generator(0, "paper claims", claim.name))
            of_group = {"scenario": scenario, "renderer": renderer, "n_runs": len(known)}
            judged = {"verdict": str(verdict(claim, *interval))}
            found.append(about | of_group | interval.columns("value") | judged)
    return pd.DataFrame(found, columns=pd.Index(VALUES.names))


def claims_table(values: pd.DataFrame) -> pd.DataFrame:
    """Return rows of VALUES as a table with one row per claim and texts in all cells."""
    rows = []
    for _, own in values.groupby("name", sort=False):
        first = own.iloc[0]
        row = {"claim": f"{first['claim']} ({first['where']})", "measure": first["measure"]}
        records: Any = own.to_dict("records")
        for of in records:
            row[f"{of['scenario']}, {of['renderer']}"] = claim_text(of)
        rows.append(row | {"why": first["why"]})
    return pd.DataFrame(rows)


def claim_text(row: Mapping[str, Any]) -> str:
    """Write verdict, value and interval of a row of VALUES."""
    if math.isnan(row["value"]):
        return str(row["verdict"])
    value, low, high = (
        "no answer" if math.isinf(row[name]) else f"{row[name]:.3g}"
        for name in ("value", "value_low", "value_high")
    )
    unit = f" {row['unit']}" if row["unit"] else ""
    interval = f" ({low} to {high})" if not math.isnan(row["value_low"]) else " (one run)"
    return f"**{row['verdict']}**: {value}{unit}{interval}"
