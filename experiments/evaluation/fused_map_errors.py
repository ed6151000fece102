"""Errors and coverage of fused maps: one row per fuser and iteration.

A fused landmark's true point is the mean of those of the landmarks it was made of. What is gross,
and what consistency is, `map_consistency.py` defines.

Of the maps before fusing too, with the landmarks of all robots together. The landmarks are those
of `map_consistency.py`: gross ones are left out. A share below its probability is of maps that are
too sure, one above of maps that know more than they say.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.alignment_errors import EvaluatedRobot, alignment_nees
from experiments.evaluation.fused_landmarks import FusedTeam
from experiments.evaluation.map_consistency import (
    Consistency,
    FittedMap,
    both_consistencies,
    fitted,
    rmse,
)
from experiments.evaluation.smoothed_robots import SmoothedRobot
from experiments.evaluation.truth import degrees_of_freedom
from mapfusion.fusion.aligned_landmarks import ABSENT
from mapfusion.fusion.fused_map import FusedMap, Fusion
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.landmark_map import LandmarkMap

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


# Shares of the errors that ellipses are to hold; closer together where gates and bounds are set.
NOMINAL = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
FUSED, FILTERED, SMOOTHED = "fused", "filter", "smoothed"  # of which maps
_Both = tuple[Consistency, Consistency]  # after the best rigid fit, and in the map's frame


def coverage_rows(fusions: Sequence[JudgedFusion]) -> list[dict[str, Any]]:
    """Rows of the table `fuser_coverage`: what went in at the last iteration, and what came out."""
    last = max((fusion.iteration for fusion in fusions), default=None)
    at_end = [fusion for fusion in fusions if fusion.iteration == last]
    rows = []
    for kind, given in _given(at_end).items():
        rows += _rows(given, at_end[0], {"map": kind, "fuser": ""})
    for fusion in at_end:
        named = {"map": FUSED, "fuser": fusion.fuser}
        rows += _rows([fusion.consistency], fusion, named)
    return rows


def _given(fusions: Sequence[JudgedFusion]) -> dict[str, list[_Both]]:
    """Each robot's maps of each kind that a fuser was given, held against the truth."""
    maps: dict[str, dict[str, tuple[EvaluatedRobot, LandmarkMap, Float]]] = {}
    for given in (given for fusion in fusions for given in fusion.given):
        robot = given.robot
        of_filter = (robot, given.of_filter, given.of_filter_world_m)
        maps.setdefault(FILTERED, {})[robot.name] = of_filter
        if given.landmarks is not given.of_filter:
            own = (robot, given.landmarks, given.points_world_m)
            maps.setdefault(SMOOTHED, {})[robot.name] = own
    return {kind: [_judged(*each) for each in own.values()] for kind, own in maps.items()}


def _judged(robot: EvaluatedRobot, landmarks: LandmarkMap, point_world_m: Float) -> _Both:
    fit = fitted(landmarks, robot.in_map_frame(point_world_m))
    return both_consistencies(landmarks, fit)


def _rows(
    maps: Sequence[_Both], fusion: JudgedFusion, named: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """One row a probability; none where nothing is known."""
    relative, frame = (
        np.concatenate([each.own_nees for each in both]) for both in zip(*maps, strict=True)
    )
    d = degrees_of_freedom(fusion.fusion.landmarks)
    for nominal in NOMINAL if len(relative) else ():
        bound = chi_square_bound(nominal, d)
        shares = {"coverage": np.mean(relative <= bound), "frame_coverage": np.mean(frame <= bound)}
        about = {"iteration": fusion.iteration, "n_landmarks": len(relative)}
        yield named | about | {"nominal": nominal} | shares
