"""Fused maps of all fusers against the truth: one row a fuser and iteration.

A fused landmark's true point is the mean of those of the landmarks it was made of. What is gross,
and what consistency is, `map_consistency.py` defines.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.errors import EvaluatedRobot, alignment_nees
from experiments.judge.fused_landmarks import FusedTeam
from experiments.judge.map_consistency import (
    Consistency,
    FittedMap,
    both_consistencies,
    fitted,
    rmse,
)
from experiments.judge.smoothed_robots import SmoothedRobot
from mapfusion import se2
from mapfusion.aligned_landmarks import ABSENT
from mapfusion.fused_map import FusedMap, Fusion
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

_MOTION_FIGURES = ("alignment_error_m", "alignment_error_rad")
_MOTION_FIGURES += ("alignment_sigma_m", "alignment_sigma_rad", "alignment_nees_per_dof")
_LEAST = 3  # landmarks in common: two fit any two


@dataclass(frozen=True)
class GivenMap:
    """What a robot gave to a fuser.

    Attributes:
        robot: whose map it is.
        landmarks: the map.
        points_world_m: (N, 3) true points.
        of_filter: the filter's map at that iteration.
        of_filter_world_m: (L, 3) its true points.
        fallback: which map stands in for the smoothed one, and why; empty if none does.
    """

    robot: EvaluatedRobot
    landmarks: LandmarkMap
    points_world_m: Float
    of_filter: LandmarkMap
    of_filter_world_m: Float
    fallback: str = ""

    @classmethod
    def at(cls, robot: EvaluatedRobot, smoothed: SmoothedRobot | None, k: int) -> "GivenMap":
        """At an iteration, as the stage `fuse` chooses it (`given_teams`).

        Args:
            robot: whose map it is.
            smoothed: for a fuser that takes smoothed maps: the last one until then is given, the
                filter's where there is none.
            k: the iteration.
        """
        filtered = robot.at(k)
        if smoothed is None:
            return cls(robot, *filtered, *filtered)
        at, why = smoothed.given_at(k)
        fallback = f"{robot.name} is not smoothed: {why}" if why else ""
        if at is None:
            return cls(robot, *filtered, *filtered, fallback)
        return cls(robot, smoothed.maps[at], smoothed.points_world_m[at], *filtered, fallback)


@dataclass(frozen=True)
class JudgedFusion:
    """A fused map with what went into it.

    Attributes:
        fuser: its name.
        iteration: of the maps.
        fusion: the map of the most robots.
        given: of all M robots.
    """

    fuser: str
    iteration: int
    fusion: FusedMap
    given: Sequence[GivenMap]

    def team(self) -> FusedTeam:
        """The same as a team of robots with the maps that were given."""
        k, robots = self.iteration, []
        for given in self.given:
            maps, points = {k: given.landmarks}, {k: given.points_world_m}
            robots.append(replace(given.robot, maps=maps, points_world_m=points))
        return FusedTeam(robots, (), k, Fusion((self.fusion,), ()))

    @property
    def fallback(self) -> str:
        """Replacement of the fuser or of a smoothed map, with the reason; else empty."""
        own = f"a simpler fuser stands in: {self.fusion.fallback}" if self.fusion.fallback else ""
        maps = (self.given[k].fallback for k in self.fusion.members)
        return "; ".join(filter(None, (own, *maps)))

    @cached_property
    def fit(self) -> FittedMap:
        """The fused map against the truth in its frame."""
        frame = self.given[self.fusion.members[0]].robot
        return fitted(self.fusion.landmarks, frame.in_map_frame(self.team().truth_of(self.fusion)))

    @cached_property
    def consistency(self) -> tuple[Consistency, Consistency]:
        """Of the fused map after the best rigid fit, and in its frame."""
        return both_consistencies(self.fusion.landmarks, self.fit)

    def row(self) -> dict[str, Any]:
        """Its row of the table `fusers`."""
        landmarks, fit = self.fusion.landmarks, self.fit
        lengths = np.linalg.norm(fit.error_m[~fit.gross], axis=1)
        relative, in_frame = self.consistency
        return {
            "fuser": self.fuser,
            "iteration": self.iteration,
            "n_robots": len(self.fusion.members),
            "n_landmarks": len(landmarks),
            "landmark_rmse_m": rmse(fit.frame_error_m[~fit.gross]),
            "fitted_rmse_m": fit.rmse_m,
            "fitted_median_m": np.median(lengths) if len(lengths) else np.nan,
            "gross_share": fit.gross_share,
            "over_better_parent": self._over_better(fit, of_filter=False),
            "over_better_filter": self._over_better(fit, of_filter=True),
            "nees_per_dof": relative.nees_per_dof,
            "marginal_nees_per_dof": relative.marginal_nees_per_dof,
            "coverage_95": relative.coverage_95,
            "frame_nees_per_dof": in_frame.marginal_nees_per_dof,
            "frame_coverage_95": in_frame.coverage_95,
            "duplicate_share": self.fusion.duplicate_share,
            "fallback": self.fallback,
        } | self._motions()

    def _over_better(self, fit: FittedMap, of_filter: bool) -> float:
        """RMS error of landmarks that two robots have, over that of the better of their maps.

        Each map is fitted to the truth as a whole; the median over pairs of robots.
        """
        parents = self._filter_rows() if of_filter else self.fusion.parents
        errors = {k: self._parent_errors(k, of_filter) for k in self.fusion.members}
        fused = np.full(len(parents), np.nan)
        fused[fit.rows[~fit.gross]] = np.linalg.norm(fit.error_m[~fit.gross], axis=1)
        ratios = []
        for a, b in itertools.combinations(self.fusion.members, 2):
            both = (parents[:, a] != ABSENT) & (parents[:, b] != ABSENT)
            of_a, of_b = errors[a][parents[both, a]], errors[b][parents[both, b]]
            three = np.stack([fused[both], of_a, of_b])
            three = three[:, np.isfinite(three).all(axis=0)]
            if three.shape[1] >= _LEAST:
                rms = np.sqrt(np.mean(three**2, axis=1))
                ratios.append(rms[0] / min(rms[1:]) if min(rms[1:]) > 0 else np.nan)
        return float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else np.nan

    def _parent_errors(self, k: int, of_filter: bool) -> Float:
        """Errors (N,) in m of a robot's map after its best fit; NaN of gross and unknown ones."""
        given = self.given[k]
        landmarks, points = given.landmarks, given.points_world_m
        if of_filter:
            landmarks, points = given.of_filter, given.of_filter_world_m
        fit, errors = fitted(landmarks, points), np.full(len(landmarks), np.nan)
        errors[fit.rows] = np.where(fit.gross, np.nan, np.linalg.norm(fit.error_m, axis=1))
        return errors

    def _filter_rows(self) -> np.ndarray:
        """The parents' rows in the filter's maps: of the same origin in the log."""
        parents = np.full_like(self.fusion.parents, ABSENT)
        for k, given in enumerate(self.given):
            origin = given.of_filter.source_observation
            row_of = pd.Series(np.arange(len(origin)), index=origin)
            has = self.fusion.parents[:, k] != ABSENT
            mine = given.landmarks.source_observation[self.fusion.parents[has, k]]
            parents[has, k] = row_of.reindex(mine).fillna(ABSENT).to_numpy(dtype=np.int64)
        return parents

    def _motions(self) -> dict[str, float]:
        """How far off the robots' maps were moved, and how far that is for its covariance."""
        first, *others = self.fusion.members
        errors = []
        for k in others:
            T_true = se2.between(
                self.given[first].robot.path.T_world_map, self.given[k].robot.path.T_world_map
            )
            off = self.fusion.T_first_map[k] - T_true
            off[2] = se2.wrap(off[2])
            covariance = self.fusion.motion_covariance[k]
            nees = alignment_nees(self.fusion.T_first_map[k], covariance, T_true)
            stated = se2.motion_sigma(covariance)
            errors.append([np.hypot(off[0], off[1]), abs(off[2]), *stated, nees / 3])
        middle = np.median(errors, axis=0) if errors else np.full(len(_MOTION_FIGURES), np.nan)
        return dict(zip(_MOTION_FIGURES, middle.tolist(), strict=True))


def fuser_rows(fusions: Sequence[JudgedFusion]) -> list[dict[str, Any]]:
    """Rows of the table `fusers`."""
    return [fusion.row() for fusion in fusions]


def last_fused(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of the table `fusers` at each fuser's last iteration, of each run."""
    keys = [name for name in ("run_id", "fuser") if name in rows]
    return rows[rows["iteration"] == rows.groupby(keys)["iteration"].transform("max")]
