"""Landmarks before and after the fusion of maps, compared with the truth.

The normalised estimation error squared (NEES; Bar-Shalom, Li, Kirubarajan 2001, ch. 5.4) of a
landmark is chi-square distributed if its covariance is right. Its degrees of freedom are the
coordinates of the landmark. Maps are compared with the truth in their own frame, the true start
pose of the robot. They are not fitted to the truth, so the error of a landmark contains the drift
of the path.

The store has complete maps of all iterations. The tables `map_history` and `fused_history` of a
result have only the columns of a floor plan.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.truth import (
    EvaluatedRobot,
    MapPair,
    fit_rmse_m,
)
from mapfusion.align.correspondences import Correspondences
from mapfusion.files import named_columns, point_columns
from mapfusion.fusion.fusers import FusedMap, Fuser, Fusion, MergeParameters
from mapfusion.fusion.kalman import Kalman, KalmanDrift, fuse_landmarks_sequentially, kalman_update
from mapfusion.fusion.landmark_association import ABSENT, AlignedLandmarks
from mapfusion.fusion.merge import connect, merge
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float, chi_square_bound, squared_mahalanobis
from mapfusion.landmark_map import LandmarkMap

GATE_PROBABILITY = 0.95
PAPER_FUSER = KalmanDrift()  # the fuser of the paper, eq. 12 to 16, with drift


@dataclass(frozen=True)
class MergeSettings:
    """Settings of the merge of maps.

    Attributes:
        aligner: name of the aligner whose alignments are used.
        parameters: parameters of the fusion.
    """

    aligner: str
    parameters: MergeParameters


@dataclass(frozen=True)
class FusedTeam:
    """Maps of a team of robots at one iteration, and their fusion.

    Attributes:
        robots: the robots.
        map_pairs: pairs of maps at all iterations.
        iteration: iteration of the fused maps.
        fusion: fused maps; None for a single robot.
    """

    robots: Sequence[EvaluatedRobot]
    map_pairs: Sequence[MapPair]
    iteration: int
    fusion: Fusion | None

    @classmethod
    def of(
        cls,
        robots: Sequence[EvaluatedRobot],
        map_pairs: Sequence[MapPair],
        settings: MergeSettings,
        fuser: Fuser = PAPER_FUSER,
    ) -> "FusedTeam":
        """Merge the last maps of all robots with the last alignment of each pair."""
        last = max(max(robot.maps) for robot in robots)
        if len(robots) < 2:
            return cls(robots, map_pairs, last, None)
        index = {robot.name: k for k, robot in enumerate(robots)}
        # the last iteration of a pair is the last frame of the robot with the longer log
        last_pairs = {(index[each.a.name], index[each.b.name]): each for each in map_pairs}
        pairs = [each.aligned(settings.aligner, a, b) for (a, b), each in last_pairs.items()]
        maps = [robot.at(last)[0] for robot in robots]
        return cls(robots, map_pairs, last, merge(maps, pairs, settings.parameters, fuser))

    @property
    def fused(self) -> FusedMap | None:
        """Fused map of the most robots."""
        return None if self.fusion is None else self.fusion.fused[0]

    def frame_of(self, fused: FusedMap) -> EvaluatedRobot:
        """Return the robot whose map frame is the frame of a fused map."""
        return self.robots[fused.members[0]]

    def truth_of(self, fused: FusedMap) -> Float:
        """Return the true positions (N, 3) of fused landmarks; NaN if unknown.

        The true point of a fused landmark is the mean of the true points of its parents.
        """
        points = self.parent_points(fused)
        is_known = np.all(np.isfinite(points), axis=2, keepdims=True)
        total, count = (
            np.where(is_known, points, 0.0).sum(axis=1),
            np.count_nonzero(is_known, axis=1),
        )
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def parent_points(self, fused: FusedMap) -> Float:
        """Return the true points of the parents of fused landmarks.

        Returns:
            Points of N landmarks in M robots' maps, shape (N, M, 3); NaN without parent or truth.
        """
        points = np.full((*fused.parents.shape, 3), np.nan)
        for k, robot in enumerate(self.robots):
            has_parent = fused.parents[:, k] != ABSENT
            points[has_parent, k] = robot.at(self.iteration)[1][fused.parents[has_parent, k]]
        return points


def fusion_rows(
    map_pairs: Sequence[MapPair], settings: MergeSettings, radius_m: float
) -> pd.DataFrame:
    """Return the rows of the table `fusion`: landmarks of a robot pair, fused at the end.

    Only landmarks with two parents have a row. Their true point is the mean of the parents' true
    points. The maps are fused with drift and without.
    """
    a, b = map_pairs[0].a, map_pairs[0].b
    by_fuser = []
    for fuser in (KalmanDrift(), Kalman()):
        pair = FusedTeam.of((a, b), map_pairs, settings, fuser)
        fused = pair.fused
        assert fused is not None
        (map_a, points_a), (map_b, points_b) = a.at(pair.iteration), b.at(pair.iteration)
        fused_rows = np.flatnonzero((fused.parents != ABSENT).all(axis=1))
        i, j = fused.parents[fused_rows].T
        # [:, None]: the matrix product of all points at once would differ in the last bits
        truth = a.in_map_frame(((points_a[i] + points_b[j]) / 2)[:, None])[:, 0]
        moved_b = se2.transform_points(fused.T_first_map[1], map_b.position_m[j][:, None])[:, 0]
        error = fused.landmarks.position_m[fused_rows] - truth
        used = fused.landmarks.n_dimensions
        covariance = fused.landmarks.covariance_m2[fused_rows, :used, :used]
        vectors = {
            "error_a_m": map_a.position_m[i] - truth,
            "error_b_m": moved_b - truth,
            "error_fused_m": error,
            "apart_m": points_a[i] - points_b[j],
        }
        lengths = pd.DataFrame({name: np.sqrt(np.vecdot(x, x)) for name, x in vectors.items()})
        rows = lengths.assign(
            robot_a=a.name,
            robot_b=b.name,
            landmark_a=i,
            landmark_b=j,
            nees=squared_mahalanobis(error[:, :used], covariance),
            degrees_of_freedom=used,
        )
        by_fuser.append(rows)
    with_drift, without_drift = by_fuser
    keys, suffixes = ["landmark_a", "landmark_b"], ("_with_drift", "_without_drift")
    rows = with_drift.merge(without_drift[[*keys, "nees"]], "left", keys, suffixes=suffixes)
    return rows.assign(true_pair=rows["apart_m"] <= radius_m)


def landmark_rows(owner: EvaluatedRobot, landmarks: LandmarkMap, points: Float) -> pd.DataFrame:
    """Return the rows of the table `landmarks` of one map.

    Args:
        owner: robot whose map frame is the frame of the map.
        landmarks: the map.
        points: true points in the world, shape (N, 3).
    """
    columns = point_columns(landmarks.position_m, landmarks.covariance_m2)
    columns |= named_columns(("truth_x_m", "truth_y_m", "truth_z_m"), owner.in_map_frame(points))
    columns |= {"landmark": np.arange(len(landmarks)), "count": landmarks.count}
    return pd.DataFrame(columns).assign(robot=owner.name)


def fused_rows(team: FusedTeam) -> pd.DataFrame:
    """Return the rows of the table `fused`; none for a single robot."""
    fused = team.fused
    if fused is None:
        return pd.DataFrame()
    rows = landmark_rows(team.frame_of(fused), fused.landmarks, team.truth_of(fused))
    has = fused.parents != ABSENT
    names = np.array([robot.name for robot in team.robots], dtype=object)
    first = np.argmax(has, axis=1)
    later = has & (np.arange(len(names)) > first[:, None])
    second, has_second = np.argmax(later, axis=1), later.any(axis=1)
    row = np.arange(len(rows))
    return rows.assign(
        n_parents=has.sum(axis=1),
        robot_a=names[first],
        landmark_a=fused.parents[row, first],
        robot_b=np.where(has_second, names[second], ""),
        landmark_b=np.where(has_second, fused.parents[row, second], ABSENT),
    )


def fused_motion_rows(team: FusedTeam) -> pd.DataFrame:
    """Return the rows of the table `fused_motions`: motions of the maps into the fused map."""
    if team.fused is None:
        return pd.DataFrame()
    reasons = dict(team.fused.left_out)
    rows = pd.DataFrame(team.fused.T_first_map, columns=["tx_m", "ty_m", "theta_rad"])
    rows["drift_sigma_m"] = team.fused.drift_sigma_m
    rows["robot"] = [robot.name for robot in team.robots]
    return rows.assign(left_out=[reasons.get(name, "") for name in rows["robot"]])


def team_edge_rows(team: FusedTeam) -> pd.DataFrame:
    """Return the rows of the table `team_edges`: the alignment of each robot pair in the team."""
    if team.fusion is None:
        return pd.DataFrame()
    pairs = list(dict.fromkeys((each.a.name, each.b.name) for each in team.map_pairs))
    rows = pd.DataFrame(pairs, columns=["robot_a", "robot_b"])
    return rows.assign(place=[str(place) for place in team.fusion.edge_status])


def map_fit_rows(team: FusedTeam) -> pd.DataFrame:
    """Return the rows of the table `map_fits`: RMSE of the robots' maps and of the fused map."""
    maps = [(robot.name, *robot.at(team.iteration)) for robot in team.robots]
    if team.fused is not None:
        maps.append(("fused", team.fused.landmarks, team.truth_of(team.fused)))
    fits = ((name, *fit_rmse_m(own.position_m, points)) for name, own, points in maps)
    return pd.DataFrame(fits, columns=["map", "n_landmarks", "rmse_m"])


def landmark_nees(landmarks: LandmarkMap, point_m: Float) -> Float:
    """Return the NEES (N,) of landmarks; NaN where the truth is unknown.

    Args:
        landmarks: map of N landmarks.
        point_m: true points in the frame of the map, shape (N, 3).
    """
    used = landmarks.n_dimensions
    error = (landmarks.position_m - point_m)[:, :used]
    covariance = landmarks.covariance_m2[:, :used, :used]
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])


def mean_nees_band(n: float, dof: int, probability: float = GATE_PROBABILITY) -> Float:
    """Return the interval of the mean NEES per degree of freedom of n consistent landmarks.

    The sum of independent NEES is chi-square distributed with n dof degrees of freedom
    (Bar-Shalom et al. 2001, eq. 5.4.2-14).

    Args:
        n: number of landmarks.
        dof: degrees of freedom of each landmark.
        probability: probability of the interval.

    Returns:
        Lower and upper end, shape (2,).
    """
    tail = (1 - probability) / 2
    ends = [chi_square_bound(share, n * dof) for share in (tail, 1 - tail)]
    return np.array(ends) / (n * dof)


def landmark_nees_rows(team: FusedTeam, radius_m: float) -> list[dict[str, Any]]:
    """Return the rows of the table `landmark_nees`: NEES before and after fusion.

    Landmarks are the same if their true points lie within the radius. Fused landmarks whose parents
    are not the same have no single true point. They are left out of "fused" and "before fusing".
    """
    rows, fused, truly_fused = [], team.fused, np.zeros(0, dtype=np.int64)
    if fused is not None:
        # landmarks with several parents, all of the same true point
        points, has = team.parent_points(fused), fused.parents != ABSENT
        distance_m = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
        both = has[:, :, None] & has[:, None]
        same = np.all(~both | (distance_m <= radius_m), axis=(1, 2))  # False for NaN
        truly_fused = np.flatnonzero(same & (has.sum(axis=1) > 1))
    for k, robot in enumerate(team.robots):
        landmarks, points = robot.at(team.iteration)
        nees = landmark_nees(landmarks, robot.in_map_frame(points))
        rows.append(_nees_row(robot.name, "own", landmarks, nees))
        if fused is not None:
            parents = fused.parents[truly_fused, k]
            fused_nees = nees[parents[parents != ABSENT]]
            rows.append(_nees_row(robot.name, "before fusing", landmarks, fused_nees))
    if fused is not None:
        nees = landmark_nees(
            fused.landmarks, team.frame_of(fused).in_map_frame(team.truth_of(fused))
        )
        single = np.count_nonzero(fused.parents != ABSENT, axis=1) == 1
        rows.append(_nees_row("fused", "fused", fused.landmarks, nees[truly_fused]))
        rows.append(_nees_row("fused", "carried over", fused.landmarks, nees[single]))
    return rows


def _nees_row(name: str, which: str, landmarks: LandmarkMap, nees: Float) -> dict[str, Any]:
    nees, dof = nees[np.isfinite(nees)], landmarks.n_dimensions
    row = {"map": name, "landmarks": which, "n_landmarks": len(nees), "degrees_of_freedom": dof}
    if len(nees):
        row |= {"nees_mean": nees.mean(), "nees_median": np.median(nees)}
        row |= {"share_in_gate": np.mean(nees <= chi_square_bound(GATE_PROBABILITY, dof))}
    return row


def map_history_rows(team: FusedTeam) -> pd.DataFrame:
    """Return the rows of the table `map_history`."""
    maps = [
        (
            {"robot": robot.name, "iteration": k},
            {"landmark": np.arange(len(landmarks))}
            | point_columns(landmarks.position_m, landmarks.covariance_m2),
        )
        for robot in team.robots
        for k, landmarks in robot.maps.items()
    ]
    return _concatenated(maps)


def true_pair_rows(team: FusedTeam, radius_m: float) -> list[dict[str, Any]]:
    """Return the rows of the table `true_pairs`."""
    rows = []
    for pair in team.map_pairs:
        bits = np.packbits(pair.is_true(radius_m)).tobytes()
        rows.append(pair.keys | {"n_correspondences": len(pair.offered), "true_pair": bits})
    return rows


def fused_history_rows(team: FusedTeam, settings: MergeSettings) -> pd.DataFrame:
    """Return the rows of the table `fused_history`: fused inliers at each iteration.

    The alignment is the first repetition of the merging aligner. A refused alignment has no rows.
    `PAPER_FUSER` fuses the inliers alone: its search for further pairs would take most of the time.
    """
    parts = []
    for map_pair in team.map_pairs:
        pair = map_pair.aligned(settings.aligner, 0, 1)
        pairs = map_pair.offered[np.flatnonzero(pair.alignment.inlier & pair.alignment.ok)]
        # the inliers are matched already and need no descriptors
        map_a, map_b = (replace(own, descriptor=None) for own in map_pair.maps)
        maps = [map_a[pairs.index_a], map_b[pairs.index_b]]
        fused: LandmarkMap | AlignedLandmarks = maps[0]
        if pair.alignment.ok:
            row = np.arange(len(pairs))
            inliers = replace(
                pair,
                alignment=replace(pair.alignment, inlier=np.ones(len(row), dtype=bool)),
                correspondences=Correspondences(row, row, pairs.distance),
            )
            component = connect(maps, [inliers], settings.parameters.team).components[0]
            fused = fuse_landmarks_sequentially(
                component, settings.parameters, kalman_update, use_drift=True
            )
        columns = {"landmark_a": pairs.index_a, "landmark_b": pairs.index_b}
        columns |= point_columns(fused.position_m, fused.covariance_m2)
        parts.append((map_pair.keys, columns))
    return _concatenated(parts)


def _concatenated(parts: Sequence[tuple[dict[str, Any], dict[str, np.ndarray]]]) -> pd.DataFrame:
    """Concatenate parts of a table; much faster than `pandas.concat` for many small parts.

    Args:
        parts: values that all rows of a part share, and the other columns of the part.
    """
    if not parts:
        return pd.DataFrame()
    shared = pd.DataFrame([values for values, _ in parts])
    n_rows = [len(next(iter(columns.values()))) for _, columns in parts]
    joined = {name: np.concatenate([columns[name] for _, columns in parts]) for name in parts[0][1]}
    return pd.DataFrame({name: shared[name].to_numpy().repeat(n_rows) for name in shared} | joined)
