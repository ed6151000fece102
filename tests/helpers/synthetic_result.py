"""A made-up result folder with the density and the looks of a real one; for tests alone."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from experiments.judge.tables import table_path, write
from mapfusion import se2
from mapfusion.se2 import Float
from mapfusion.storage import point_columns

ALIGNERS = ("ransac", "svd", "svd-solved", "icp", "impicp")
# Scale of the translation error (m), of the rotation error (rad), and how much both scatter.
_ERROR_SCALES = {
    "ransac": (0.08, 0.003, 0.2),
    "svd": (2.5, -0.25, 0.0),
    "svd-solved": (1.2, -0.25, 0.0),
    "icp": (1.5, -0.10, 0.9),
    "impicp": (0.9, -0.06, 0.7),
    "oracle": (0.07, 0.002, 0.0),
}
_WALLS = (
    ((0, 0), (20, 0), (20, 15), (0, 15), (0, 0)),
    ((7, 0), (7, 4)),
    ((7, 6), (7, 15)),
    ((13, 0), (13, 9)),
    ((13, 11), (13, 15)),
    ((0, 8), (5, 8)),
    ((15, 7), (20, 7)),
)
_ROUTES = (
    ((1.5, 1.5), (5.5, 1.5), (5.5, 6.5), (10, 5), (10, 13), (5, 11), (1.5, 13), (1.5, 10)),
    ((18.5, 1.5), (15, 1.5), (14.5, 10), (10, 10), (10, 2), (11.5, 6), (14.5, 10), (18.5, 5)),
    ((18.5, 13.5), (15, 13), (15, 10), (10, 10), (10, 13.5), (5, 5), (2, 2), (10, 10)),
)
ALIGNMENT_ERROR = np.array([0.04, -0.03, 0.004])  # of the motions the maps were merged with
DRIFT_SIGMA_M = 0.03  # that the merge added to each map's covariances
_SEEN_WITHIN_M = 3.2
_PAIR_RADIUS_M = 0.10
_IMAGE_SHAPE = (480, 640)


@dataclass(frozen=True)
class Size:
    """How large a result to make up; the defaults are those of the paper's scenario."""

    robots: int = 3
    iterations: int = 1200
    every: int = 25
    repetitions: int = 20
    particles: int = 200
    world_points: int = 3600
    keyframes: int = 6


SMALL = Size(iterations=200, every=25, repetitions=5, particles=40, world_points=600, keyframes=3)


def write_result(folder: Path, size: Size = SMALL, seed: int = 0, world: bool = True) -> Path:
    """Write all tables, the key frames and the descriptions; returns the folder."""
    rng = np.random.default_rng(seed)
    robots = [f"R{i + 1}" for i in range(size.robots)]
    points = _wall_points(rng, size.world_points)
    paths = {robot: _path(route, size) for robot, route in zip(robots, _ROUTES, strict=False)}
    maps = {robot: _map(rng, paths[robot], points) for robot in robots}
    _write_descriptions(folder, paths, world)
    tables: dict[str, pd.DataFrame | list[dict]] = {
        "robots": _robot_rows(rng, paths, maps),
        "paths": _path_rows(rng, paths),
        "clouds": _cloud_rows(rng, paths, size),
        "landmarks": _landmark_rows(maps),
        "tracks": _track_rows(rng, robots[0], size) if size.keyframes else [],
        "fused": _fused_rows(maps),
        "timings": [{"stage": "slam", "name": "R1", "elapsed_s": 1.0}],
    }
    tables |= _alignment_tables(rng, maps, size)
    tables |= _history_tables(maps, tables["correspondences"], tables["errors"])
    for name in ("fusion", "map_fits"):
        tables[name] = []
    for name, rows in tables.items():
        write(table_path(folder, name), name, rows)
    for k in range(size.keyframes):
        _write_image(rng, folder / "keyframes" / f"{robots[0]}_{60 + k:05d}.png")
    return folder


def _wall_points(rng: np.random.Generator, n: int) -> Float:
    ends = np.array([ends for wall in _WALLS for ends in pairwise(wall)], float)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    wall = rng.choice(len(ends), n, p=length / length.sum())
    along = rng.uniform(size=(n, 1))
    plan = ends[wall, 0] * (1 - along) + ends[wall, 1] * along
    return np.column_stack([plan, rng.uniform(0.1, 2.4, n)])


def _path(route: Sequence[tuple[float, float]], size: Size) -> Float:
    """World poses (T, 3) along a closed route, with a whole second round."""
    corners = np.array([*route, *route, route[0]], dtype=np.float64)
    distance = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0, 0.62 * distance[-1], size.iterations)
    plan = np.column_stack([np.interp(at, distance, corners[:, i]) for i in range(2)])
    step = np.gradient(plan, axis=0)
    return np.column_stack([plan, np.arctan2(step[:, 1], step[:, 0])])


@dataclass(frozen=True)
class _Map:
    start: Float
    points: np.ndarray  # rows of the world's points
    truth_m: Float
    position_m: Float
    covariance_m2: Float


def _map(rng: np.random.Generator, path: Float, points: Float) -> _Map:
    offset = points[:, None, :2] - path[None, ::10, :2]
    distance = np.linalg.norm(offset, axis=2)
    nearest = distance.argmin(axis=1)
    seen = np.flatnonzero(distance.min(axis=1) < _SEEN_WITHIN_M)
    start = path[0]
    truth = se2.transform_points(se2.inverse(start), points[seen])
    ray = offset[seen, nearest[seen]]
    heading = np.arctan2(ray[:, 1], ray[:, 0]) - start[2]
    sigma = np.stack([rng.uniform(0.03, 0.12, len(seen)), rng.uniform(0.02, 0.05, len(seen))], -1)
    rotation = se2.rotation_about_z(heading)
    variance = np.column_stack([sigma**2, np.full(len(seen), 0.02**2)])
    covariance = rotation @ (variance[:, :, None] * rotation.swapaxes(1, 2))
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=truth.shape))
    drift = 0.03 * np.sin(truth[:, [1, 0, 0]] / 4) * [1, 1, 0]
    return _Map(start, seen, truth, truth + noise + drift, covariance)


def _write_descriptions(folder: Path, paths: dict[str, Float], world: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    scenario = {
        "name": "made-up",
        "seed": 0,
        "align": {"aligners": [{"name": name, "method": name} for name in ALIGNERS]},
        "evaluate": {"true_pair_radius_m": _PAIR_RADIUS_M},
        "merge": {"aligner": "ransac"},
    }
    (folder / "scenario.json").write_text(json.dumps(scenario))
    if world:
        starts = {robot: path[0].tolist() for robot, path in paths.items()}
        (folder / "world.json").write_text(json.dumps({"walls": _WALLS, "robots": starts}))


def _spread(n: int) -> Float:
    """A saw-tooth: grows in new territory, falls where a loop closes."""
    phase = np.arange(n) / n
    return 0.01 + 0.16 * np.where(phase < 0.62, phase, 0.25 * (phase - 0.62) + 0.03)


def _robot_rows(
    rng: np.random.Generator, paths: dict[str, Float], maps: dict[str, _Map]
) -> pd.DataFrame:
    frames = []
    for robot, path in paths.items():
        n = len(path)
        frames.append(
            pd.DataFrame(
                {
                    "robot": robot,
                    "iteration": np.arange(n),
                    "path_error_m": 0.08 + 0.01 * rng.normal(size=n),
                    "path_error_rad": 0.01,
                    "odometry_error_m": np.linspace(0, 0.6, n),
                    "odometry_error_rad": 0.05,
                    "effective_sample_size": rng.uniform(50, 150, n),
                    "resampled": rng.uniform(size=n) < 0.2,
                    "n_landmarks": np.linspace(0, len(maps[robot].points), n).astype(int),
                    "spread_m": _spread(n) * rng.uniform(0.95, 1.05, n),
                }
            )
        )
    return pd.concat(frames)


def _own_frame(path: Float) -> Float:
    return se2.between(path[0], path)


def _path_rows(rng: np.random.Generator, paths: dict[str, Float]) -> pd.DataFrame:
    frames = []
    for robot, path in paths.items():
        own = _own_frame(path)
        columns: dict[str, object] = {"robot": robot, "iteration": np.arange(len(path))}
        for source, sigma in (("final", 0.01), ("online", 0.02), ("odometry", 0.2), ("truth", 0)):
            noisy = own + np.array([sigma, sigma, 0]) * rng.normal(size=own.shape)
            for i, field in enumerate(("x_m", "y_m", "theta_rad")):
                columns[f"{source}_{field}"] = noisy[:, i]
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames)


def _cloud_rows(rng: np.random.Generator, paths: dict[str, Float], size: Size) -> pd.DataFrame:
    frames = []
    for robot, path in paths.items():
        own, spread = _own_frame(path), _spread(len(path))
        for k in sorted({*range(0, len(path), 10), len(path) - 1}):
            across = rng.normal(size=(size.particles, 2)) * spread[k] * [0.4, 0.92]
            points = own[k, :2] + across @ se2.rotation(own[k, 2]).T
            frames.append(
                pd.DataFrame(
                    {
                        "robot": robot,
                        "iteration": k,
                        "particle": np.arange(size.particles),
                        "x_m": points[:, 0],
                        "y_m": points[:, 1],
                        "theta_rad": own[k, 2],
                        "log_weight": -np.log(size.particles),
                    }
                )
            )
    return pd.concat(frames)


def _truth_columns(truth_m: Float) -> dict[str, Float]:
    return {f"truth_{axis}_m": truth_m[:, i] for i, axis in enumerate("xyz")}


def _landmark_rows(maps: dict[str, _Map]) -> pd.DataFrame:
    return pd.concat(
        pd.DataFrame(
            {
                "robot": robot,
                "landmark": np.arange(len(landmarks.points)),
                **point_columns(landmarks.position_m, landmarks.covariance_m2),
                "count": 5,
                **_truth_columns(landmarks.truth_m),
            }
        )
        for robot, landmarks in maps.items()
    )


def _alignment_tables(
    rng: np.random.Generator, maps: dict[str, _Map], size: Size
) -> dict[str, list[dict]]:
    tables: dict[str, list[dict]] = {
        name: [] for name in ("estimates", "errors", "correspondences", "aligner_timings")
    }
    evaluated = [*range(size.every - 1, size.iterations, size.every)]
    for robot_a, robot_b in combinations(maps, 2):
        for iteration in evaluated:
            names = {"robot_a": robot_a, "robot_b": robot_b, "iteration": iteration}
            share = (iteration + 1) / size.iterations
            pairs, is_true, n_common = _correspondences(rng, maps[robot_a], maps[robot_b], share)
            tables["correspondences"] += [names | pair for pair in pairs]
            T_true = se2.between(maps[robot_a].start, maps[robot_b].start)
            _append_estimates(rng, tables, names, T_true, is_true, n_common, size)
            if iteration % (4 * size.every) == size.every - 1:
                _append_timings(rng, tables["aligner_timings"], names, len(pairs), n_common)
    return tables


def _correspondences(
    rng: np.random.Generator, a: _Map, b: _Map, share: float
) -> tuple[list[dict], np.ndarray, int]:
    known_a = np.flatnonzero(a.points < share**0.5 * a.points.max())
    known_b = np.flatnonzero(b.points < share**0.5 * b.points.max())
    common = np.intersect1d(a.points[known_a], b.points[known_b])
    common = common[: int(len(common) * max(0.0, share - 0.15))]
    true = common[: len(common) // 4]
    n_false = int(20 + 150 * share)
    index_a = [*np.searchsorted(a.points, true), *rng.choice(known_a, n_false)]
    index_b = [*np.searchsorted(b.points, true), *rng.choice(known_b, n_false)]
    rows = [
        {"index_a": int(i), "index_b": int(j), "descriptor_distance": float(rng.uniform(0.1, 0.4))}
        for i, j in zip(index_a, index_b, strict=True)
    ]
    return rows, np.arange(len(rows)) < len(true), len(common)


def _append_estimates(
    rng: np.random.Generator,
    tables: dict[str, list[dict]],
    names: dict,
    T_true: Float,
    is_true: np.ndarray,
    n_common: int,
    size: Size,
) -> None:
    n_true = int(is_true.sum())
    lost = n_true < 3
    for aligner, (scale_m, scale_rad, scatter) in _ERROR_SCALES.items():
        refined = aligner == "oracle" or aligner == "ransac" or rng.uniform() < 0.6
        for repetition in range(1 if aligner == "oracle" else size.repetitions):
            factor = np.exp(scatter * rng.normal()) * (6 if lost and aligner != "oracle" else 1)
            translation, rotation = scale_m * factor, scale_rad * factor * rng.uniform(-0.3, 1)
            good = refined and not lost
            row = names | {"aligner": aligner, "repetition": repetition, "reason": ""}
            row |= {"refined_reason": ""}
            row |= {"status": "accepted", "refined_status": "accepted"}
            row |= {"accepted": not lost, "log10_false_alarms": 2.0 if lost else -30.0}
            refined_errors = (0.075, 0.0025) if good else (translation, rotation)
            if aligner == "oracle" and lost:
                row |= {"status": "degenerate", "refined_status": "degenerate"}
                translation = rotation = np.nan
                refined_errors = (np.nan, np.nan)
            tables["errors"].append(
                row
                | {
                    "translation_error_m": translation,
                    "rotation_error_rad": rotation,
                    "refined_translation_error_m": refined_errors[0],
                    "refined_rotation_error_rad": refined_errors[1],
                    "oracle_distance_m": 0.0,
                    "oracle_distance_rad": 0.0,
                    "n_correspondences": len(is_true),
                    "n_true": n_true,
                    "n_common": n_common,
                    "n_inliers": n_true,
                    "precision": 1.0,
                    "recall": 1.0,
                    "alignment_nees": 3.0,
                }
            )
            if aligner != "oracle":
                tables["estimates"].append(
                    row
                    | _estimate_columns(T_true, translation, rotation)
                    | {
                        "acceptance_reason": "chance does as well" if lost else "",
                        "n_correspondences": len(is_true),
                        "inliers": np.packbits(is_true).tobytes(),
                        "refined_inliers": np.packbits(is_true).tobytes(),
                    }
                )


def _estimate_columns(T_true: Float, translation: float, rotation: float) -> dict[str, float]:
    estimate = {
        "tx_m": T_true[0] + translation,
        "ty_m": T_true[1],
        "theta_rad": T_true[2] + rotation,
    }
    refined = {f"refined_{name}": value for name, value in estimate.items()}
    covariance = {f"cov_{name}": 1e-4 for name in ("xx", "xy", "xt", "yy", "yt", "tt")}
    return estimate | refined | covariance | {"drift_sigma_m": 0.05}


def _history_tables(
    maps: dict[str, _Map], offered: list[dict], errors: list[dict]
) -> dict[str, pd.DataFrame]:
    """The last maps at each evaluated iteration; the true pairs, fused half way between."""
    if not offered:  # one robot alone
        return {}
    pairs = pd.DataFrame(offered)
    whole = {robot: _plan_rows(own.position_m, own.covariance_m2) for robot, own in maps.items()}
    history = [
        plan.assign(robot=robot, iteration=k, landmark=np.arange(len(plan)))
        for robot, plan in whole.items()
        for k in pairs["iteration"].unique()
    ]
    key = ["robot_a", "robot_b", "iteration"]
    n_true = pd.DataFrame(errors).groupby(key)["n_true"].first()
    judged, fused = [], []
    for (a, b, k), rows in pairs.groupby(key):
        index_a, index_b = rows["index_a"].to_numpy(), rows["index_b"].to_numpy()
        is_true = np.arange(len(rows)) < n_true[a, b, k]  # as they are put together
        names = {"robot_a": a, "robot_b": b, "iteration": k}
        bits = np.packbits(is_true).tobytes()
        judged.append(names | {"n_correspondences": len(rows), "true_pair": bits})
        joined = whole[a].iloc[index_a[is_true]]
        fused.append(
            joined.assign(**names, landmark_a=index_a[is_true], landmark_b=index_b[is_true])
        )
    return {
        "map_history": pd.concat(history),
        "true_pairs": pd.DataFrame(judged),
        "fused_history": pd.concat(fused),
    }


def _plan_rows(position_m: Float, covariance_m2: Float) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "x_m": position_m[:, 0],
            "y_m": position_m[:, 1],
            "cov_xx_m2": covariance_m2[:, 0, 0],
            "cov_xy_m2": covariance_m2[:, 0, 1],
            "cov_yy_m2": covariance_m2[:, 1, 1],
        }
    )


def _append_timings(
    rng: np.random.Generator, rows: list[dict], names: dict, n_pairs: int, n_common: int
) -> None:
    for place, aligner in enumerate(ALIGNERS):
        elapsed = 1e-4 * (1 + place) * (1 + n_pairs / 80) * float(rng.uniform(0.9, 1.1))
        rows.append(
            names
            | {
                "aligner": aligner,
                "n_correspondences": n_pairs,
                "n_common": n_common,
                "elapsed_s": elapsed,
                "elapsed_low_s": 0.9 * elapsed,
                "elapsed_high_s": 1.3 * elapsed,
            }
        )


def _fused_rows(maps: dict[str, _Map]) -> pd.DataFrame:
    """Eq. 12-14 in the information form, for every other point that two robots know."""
    start = next(iter(maps.values())).start
    rows: list[dict] = []
    owners: dict[int, list[tuple[str, int]]] = {}
    for robot, landmarks in maps.items():
        for landmark, point in enumerate(landmarks.points):
            owners.setdefault(int(point), []).append((robot, landmark))
    for point, parents in owners.items():
        kept = parents[:2] if point % 2 == 0 else []
        groups = ([kept] if len(kept) == 2 else []) + [[p] for p in parents if p not in kept]
        rows += [_fused_row(maps, start, group) for group in groups]
    columns = {name: np.stack([row[name] for row in rows]) for name in ("position", "covariance")}
    frame = pd.DataFrame([{k: v for k, v in row.items() if k not in columns} for row in rows])
    points = point_columns(columns["position"], columns["covariance"])
    return frame.assign(landmark=np.arange(len(rows)), **points)


def _fused_row(maps: dict[str, _Map], start: Float, parents: list[tuple[str, int]]) -> dict:
    information, weighted = np.zeros((3, 3)), np.zeros(3)
    for robot, landmark in parents:
        own = maps[robot]
        T_fused = se2.between(start, own.start)
        if own.start is not start:
            T_fused = T_fused + ALIGNMENT_ERROR
        here = slice(landmark, landmark + 1)
        position = se2.transform_points(T_fused, own.position_m[here])[0]
        turned = se2.transform_covariances(T_fused, own.covariance_m2[here])[0]
        inverse = np.linalg.inv(turned + DRIFT_SIGMA_M**2 * np.diag([1, 1, 0]))
        information += inverse
        weighted += inverse @ position
    covariance = np.linalg.inv(information)
    names = [*parents, ("", -1)]
    return {
        "position": covariance @ weighted,
        "covariance": covariance,
        "n_parents": len(parents),
        "robot_a": names[0][0],
        "landmark_a": names[0][1],
        "robot_b": names[1][0],
        "landmark_b": names[1][1],
        "truth_x_m": np.nan,
        "truth_y_m": np.nan,
        "truth_z_m": np.nan,
    }


def _track_rows(rng: np.random.Generator, robot: str, size: Size) -> pd.DataFrame:
    height, width = _IMAGE_SHAPE
    born = rng.integers(-15, size.keyframes, 90)
    start = np.column_stack([rng.uniform(0, width, 90), rng.uniform(0, height, 90)])
    frames = []
    for k in range(size.keyframes):
        at = start + (k - born)[:, None] * [5.0, 0.5]
        alive = (born <= k) & np.all((at > 0) & (at < [width, height]), axis=1)
        frames.append(
            pd.DataFrame(
                {
                    "robot": robot,
                    "iteration": 60 + k,
                    "track": np.flatnonzero(alive),
                    "length": (k - born + 1)[alive],
                    "u_px": at[alive, 0],
                    "v_px": at[alive, 1],
                }
            )
        )
    return pd.concat(frames)


def _write_image(rng: np.random.Generator, path: Path) -> None:
    """Blobs at several scales, about as hard to compress as a rendered wall."""
    height, width = _IMAGE_SHAPE
    image = np.zeros(_IMAGE_SHAPE)
    for cell in (8, 24, 80):
        coarse = rng.uniform(size=(height // cell + 2, width // cell + 2))
        image += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)
    image = 70 * image + rng.normal(scale=2.0, size=_IMAGE_SHAPE)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.clip(image, 0, 255).astype(np.uint8))
