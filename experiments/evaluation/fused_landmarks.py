"""Landmarks before and after merging, compared with the truth.

The normalised estimation error squared (NEES; Bar-Shalom, Li, Kirubarajan 2001, ch. 5.4) of a
landmark is chi-square distributed, with as many degrees of freedom as it has coordinates, if its
covariance is right. Maps are compared with the truth in their own frame, the robot's true start
pose, without a fit: what the path's drift does to a landmark is part of its error.

The stages keep the maps whole in the store; what leaves with the result is what one needs to look
at them in plan.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.alignment_errors import EvaluatedRobot, MetMaps
from experiments.evaluation.truth import degrees_of_freedom, fit_rmse_m, squared_mahalanobis
from mapfusion.align.correspondences import Correspondences
from mapfusion.files import named_columns, point_columns
from mapfusion.fusion.aligned_landmarks import ABSENT, AlignedLandmarks
from mapfusion.fusion.fused_map import FusedMap, Fusion, MergeParameters
from mapfusion.fusion.fusers import Fuser
from mapfusion.fusion.kalman import Kalman, KalmanDrift, fuse_landmarks_sequentially, kalman_update
from mapfusion.fusion.merge import connect, merge
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.landmark_map import LandmarkMap

GATE_PROBABILITY = 0.95
PAPERS = KalmanDrift()  # what the tables of fused landmarks are of: eq. 12 to 16, with drift


@dataclass(frozen=True)
class MergeSettings:
    """Whose alignments maps are merged by, and how."""

    aligner: str
    parameters: MergeParameters


@dataclass(frozen=True)
class FusedTeam:
    """Robots' maps at one iteration, and what they were merged into."""

    robots: Sequence[EvaluatedRobot]
    met: Sequence[MetMaps]  # at all iterations
    iteration: int
    fusion: Fusion | None  # None for a single robot

    @classmethod
    def of(
        cls,
        robots: Sequence[EvaluatedRobot],
        met: Sequence[MetMaps],
        settings: MergeSettings,
        fuser: Fuser = PAPERS,
    ) -> "FusedTeam":
        """Merge the robots' last maps by their last alignments with each other."""
        last = max(max(robot.maps) for robot in robots)
        if len(robots) < 2:
            return cls(robots, met, last, None)
        place = {robot.name: k for k, robot in enumerate(robots)}
        # a pair's last iteration is at the later of its two robots' last frames
        ends = {(place[each.a.name], place[each.b.name]): each for each in met}
        pairs = [each.aligned(settings.aligner, a, b) for (a, b), each in ends.items()]
        maps = [robot.at(last)[0] for robot in robots]
        return cls(robots, met, last, merge(maps, pairs, settings.parameters, fuser))

    @property
    def fused(self) -> FusedMap | None:
        """The map of the most robots."""
        return None if self.fusion is None else self.fusion.fused[0]

    def frame_of(self, fused: FusedMap) -> EvaluatedRobot:
        """The robot in whose frame a fused map is."""
        return self.robots[fused.members[0]]

    def truth_of(self, fused: FusedMap) -> Float:
        """True points (N, 3) of fused landmarks: the mean of their parents'; NaN if unknown."""
        points = self.parent_points(fused)
        known = np.all(np.isfinite(points), axis=2, keepdims=True)
        total, count = np.where(known, points, 0.0).sum(axis=1), np.count_nonzero(known, axis=1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def parent_points(self, fused: FusedMap) -> Float:
        """True points (N, M, 3) of each fused landmark's parents; NaN where none or unknown."""
        points = np.full((*fused.parents.shape, 3), np.nan)
        for k, robot in enumerate(self.robots):
            has = fused.parents[:, k] != ABSENT
            points[has, k] = robot.at(self.iteration)[1][fused.parents[has, k]]
        return points

    def judged(self) -> list[tuple[str, LandmarkMap, Float]]:
        """Name, map and true points (N, 3) in the world of each robot's map and the fused one."""
        found = [(robot.name, *robot.at(self.iteration)) for robot in self.robots]
        if self.fused is not None:
            found.append(("fused", self.fused.landmarks, self.truth_of(self.fused)))
        return found


def fusion_rows(met: Sequence[MetMaps], settings: MergeSettings, radius_m: float) -> pd.DataFrame:
    """Rows of the table `fusion`: landmarks of one pair fused at the last iteration."""
    robots, keys, fused = (met[0].a, met[0].b), ["landmark_a", "landmark_b"], []
    for fuser in (KalmanDrift(), Kalman()):
        fused.append(FusedTeam.of(robots, met, settings, fuser))
    with_drift, without_drift = map(_pair_rows, fused)
    other, suffixes = without_drift[[*keys, "nees"]], ("_with_drift", "_without_drift")
    rows = with_drift.merge(other, "left", keys, suffixes=suffixes)
    return rows.assign(true_pair=rows["apart_m"] <= radius_m)


def _pair_rows(pair: FusedTeam) -> pd.DataFrame:
    """Landmarks with two parents, held against the middle of what both of these show."""
    (a, b), fused = pair.robots, pair.fused
    assert fused is not None
    (map_a, points_a), (map_b, points_b) = a.at(pair.iteration), b.at(pair.iteration)
    both = np.flatnonzero((fused.parents != ABSENT).all(axis=1))
    i, j = fused.parents[both].T
    # points one by one, [:, None]: products of matrices differ in their last bits from these
    truth = a.in_map_frame(((points_a[i] + points_b[j]) / 2)[:, None])[:, 0]
    moved_b = se2.transform_points(fused.T_first_map[1], map_b.position_m[j][:, None])[:, 0]
    error = fused.landmarks.position_m[both] - truth
    used = degrees_of_freedom(fused.landmarks)
    covariance = fused.landmarks.covariance_m2[both, :used, :used]
    lengths = {
        "error_a_m": map_a.position_m[i] - truth,
        "error_b_m": moved_b - truth,
        "error_fused_m": error,
        "apart_m": points_a[i] - points_b[j],
    }
    rows = pd.DataFrame({name: np.sqrt(np.vecdot(x, x)) for name, x in lengths.items()})
    return rows.assign(
        robot_a=a.name,
        robot_b=b.name,
        landmark_a=i,
        landmark_b=j,
        nees=squared_mahalanobis(error[:, :used], covariance),
        degrees_of_freedom=used,
    )


def landmark_rows(owner: EvaluatedRobot, landmarks: LandmarkMap, points: Float) -> pd.DataFrame:
    """Rows of the table `landmarks` of one map; true points in the frame of its owner's maps."""
    columns = point_columns(landmarks.position_m, landmarks.covariance_m2)
    columns |= named_columns(("truth_x_m", "truth_y_m", "truth_z_m"), owner.in_map_frame(points))
    columns |= {"landmark": np.arange(len(landmarks)), "count": landmarks.count}
    return pd.DataFrame(columns).assign(robot=owner.name)


def fused_rows(team: FusedTeam) -> pd.DataFrame:
    """Rows of the table `fused`; none for a single robot."""
    fused = team.fused
    if fused is None:
        return pd.DataFrame()
    rows = landmark_rows(team.frame_of(fused), fused.landmarks, team.truth_of(fused))
    has = fused.parents != ABSENT
    names = np.array([robot.name for robot in team.robots], dtype=object)
    first = np.argmax(has, axis=1)
    later = has & (np.arange(len(names)) > first[:, None])
    second, several = np.argmax(later, axis=1), later.any(axis=1)
    each = np.arange(len(rows))
    return rows.assign(
        n_parents=has.sum(axis=1),
        robot_a=names[first],
        landmark_a=fused.parents[each, first],
        robot_b=np.where(several, names[second], ""),
        landmark_b=np.where(several, fused.parents[each, second], ABSENT),
    )


def fused_motion_rows(team: FusedTeam) -> pd.DataFrame:
    """Rows of the table `fused_motions`: how each robot's map was moved into the fused one."""
    if team.fused is None:
        return pd.DataFrame()
    why = dict(team.fused.left_out)
    rows = pd.DataFrame(team.fused.T_first_map, columns=["tx_m", "ty_m", "theta_rad"])
    rows["drift_sigma_m"] = team.fused.drift_sigma_m
    rows["robot"] = [robot.name for robot in team.robots]
    return rows.assign(left_out=[why.get(name, "") for name in rows["robot"]])


def team_edge_rows(team: FusedTeam) -> pd.DataFrame:
    """Rows of the table `team_edges`: what the others say of each two robots' alignment."""
    if team.fusion is None:
        return pd.DataFrame()
    pairs = list(dict.fromkeys((each.a.name, each.b.name) for each in team.met))
    rows = pd.DataFrame(pairs, columns=["robot_a", "robot_b"])
    return rows.assign(place=[str(place) for place in team.fusion.edge_status])


def map_fit_rows(team: FusedTeam) -> pd.DataFrame:
    """Rows of the table `map_fits`: each robot's map, and the fused one, against the truth."""
    fits = ((name, *fit_rmse_m(own.position_m, points)) for name, own, points in team.judged())
    return pd.DataFrame(fits, columns=["map", "n_landmarks", "rmse_m"])


def landmark_nees(landmarks: LandmarkMap, point_m: Float) -> Float:
    """NEES (N,; source above) by true points (N, 3) in the map's frame; NaN where unknown."""
    used = degrees_of_freedom(landmarks)
    error = (landmarks.position_m - point_m)[:, :used]
    covariance = landmarks.covariance_m2[:, :used, :used]
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])


def mean_nees_band(n: float, dof: int, probability: float = GATE_PROBABILITY) -> Float:
    """Where the mean of n independent NEES over their degrees of freedom lies, if consistent.

    Their sum is chi-square with n dof degrees of freedom (Bar-Shalom et al. 2001, eq. 5.4.2-14).
    """
    tail = (1 - probability) / 2
    ends = [chi_square_bound(share, n * dof) for share in (tail, 1 - tail)]
    return np.array(ends) / (n * dof)


def landmark_nees_rows(team: FusedTeam, radius_m: float) -> list[dict[str, Any]]:
    """Rows of the table `landmark_nees`: each robot's map, and what became of it when merged.

    Landmarks whose true points lie within the radius are one; fused ones whose parents are not have
    no single truth and are left out of "fused" and "before fusing".
    """
    rows, fused = [], team.fused
    true_rows = [] if fused is None else _truly_fused(team, fused, radius_m)
    for place, robot in enumerate(team.robots):
        landmarks, points = robot.at(team.iteration)
        nees = landmark_nees(landmarks, robot.in_map_frame(points))
        rows.append(_row(robot.name, "own", landmarks, nees))
        if fused is not None:
            parents = fused.parents[true_rows, place]
            fused_nees = nees[parents[parents != ABSENT]]
            rows.append(_row(robot.name, "before fusing", landmarks, fused_nees))
    if fused is not None:
        nees = landmark_nees(
            fused.landmarks, team.frame_of(fused).in_map_frame(team.truth_of(fused))
        )
        single = np.count_nonzero(fused.parents != ABSENT, axis=1) == 1
        rows.append(_row("fused", "fused", fused.landmarks, nees[true_rows]))
        rows.append(_row("fused", "carried over", fused.landmarks, nees[single]))
    return rows


def _truly_fused(team: FusedTeam, fused: FusedMap, radius_m: float) -> np.ndarray:
    """Rows of the fused map with several parents, all of which show one true point."""
    points, has = team.parent_points(fused), fused.parents != ABSENT
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    both = has[:, :, None] & has[:, None]
    together = np.all(~both | (apart <= radius_m), axis=(1, 2))  # NaN is not together
    return np.flatnonzero(together & (has.sum(axis=1) > 1))


def _row(name: str, which: str, landmarks: LandmarkMap, nees: Float) -> dict[str, Any]:
    nees, dof = nees[np.isfinite(nees)], degrees_of_freedom(landmarks)
    row = {"map": name, "landmarks": which, "n_landmarks": len(nees), "degrees_of_freedom": dof}
    if len(nees):
        row |= {"nees_mean": nees.mean(), "nees_median": np.median(nees)}
        row |= {"share_in_gate": np.mean(nees <= chi_square_bound(GATE_PROBABILITY, dof))}
    return row


def map_history_rows(team: FusedTeam) -> pd.DataFrame:
    """Rows of the table `map_history`."""
    maps = [
        (
            {"robot": robot.name, "iteration": k},
            {"landmark": np.arange(len(landmarks))} | _points(landmarks),
        )
        for robot in team.robots
        for k, landmarks in robot.maps.items()
    ]
    return _rows(maps)


def true_pair_rows(team: FusedTeam, radius_m: float) -> list[dict[str, Any]]:
    """Rows of the table `true_pairs`."""
    return [
        met.names
        | {
            "n_correspondences": len(met.offered),
            "true_pair": np.packbits(met.is_true(radius_m)).tobytes(),
        }
        for met in team.met
    ]


def fused_history_rows(team: FusedTeam, settings: MergeSettings) -> pd.DataFrame:
    """Rows of the table `fused_history`."""
    return _rows([(met.names, _joined(met, settings)) for met in team.met])


def _rows(parts: Sequence[tuple[dict[str, Any], dict[str, np.ndarray]]]) -> pd.DataFrame:
    """Rows of parts: what is said of all rows of a part, and columns; these are the same of all.

    All in one frame at once: to make one of each part takes many times as long.
    """
    if not parts:
        return pd.DataFrame()
    said = pd.DataFrame([named for named, _ in parts])
    n_rows = [len(next(iter(columns.values()))) for _, columns in parts]
    joined = {name: np.concatenate([columns[name] for _, columns in parts]) for name in parts[0][1]}
    return pd.DataFrame({name: said[name].to_numpy().repeat(n_rows) for name in said} | joined)


def _points(landmarks: LandmarkMap | AlignedLandmarks) -> dict[str, np.ndarray]:
    return point_columns(landmarks.position_m, landmarks.covariance_m2)


def _joined(met: MetMaps, settings: MergeSettings) -> dict[str, np.ndarray]:
    """The inliers of the merging aligner's first repetition, fused; none where it was refused.

    As `PAPERS` fuses them, and only they are given: the second pass, which looks for what they
    missed, takes ten times as long as all the rest of this table.
    """
    pair = met.aligned(settings.aligner, 0, 1)
    pairs = met.offered[np.flatnonzero(pair.alignment.inlier & pair.alignment.ok)]
    # all are paired already: nobody looks at their descriptors
    map_a, map_b = (replace(own, descriptor=None) for own in met.maps)
    fused, each = map_a[pairs.index_a], np.arange(len(pairs))
    if pair.alignment.ok:
        alone = replace(
            pair,
            alignment=replace(pair.alignment, inlier=np.ones(len(each), dtype=bool)),
            correspondences=Correspondences(each, each, pairs.distance),
        )
        both = connect([fused, map_b[pairs.index_b]], [alone], settings.parameters.team)
        fused = fuse_landmarks_sequentially(
            both.components[0], settings.parameters, kalman_update, use_drift=True
        )
    return {"landmark_a": pairs.index_a, "landmark_b": pairs.index_b} | _points(fused)
