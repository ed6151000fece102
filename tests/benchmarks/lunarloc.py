"""Boulder maps of LunarLoc aligned by geometry alone: right, accepted and wrong pairs, and times.

    MAPFUSION_LUNARLOC=FOLDER python -m tests.benchmarks.lunarloc [--mirrored 300] [--times]

where FOLDER holds `traverse_N.csv` of the dataset mit-acl/lunarloc-data. The detections of a
traverse are clustered into landmarks, and its map is moved into a frame of its own. Landmarks of
two traverses are common if they lie within 0.25 m of each other in the true frame. Prints a line
for each pair of traverses, the shares, the least number of false alarms of mirrored maps, and with
`--times` the processor time of simulated boulder fields.
"""

import argparse
import ast
import csv
import itertools
import math
import os
import resource
import sys
import time
from pathlib import Path

import numpy as np
import scipy

from mapfusion.align.aligners import make_aligner
from mapfusion.align.correspondences import match
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import inverse, rms_distance_m, transform_points
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.registration import Registered, Registration
from tests.mapfusion.align.made_fields import made_field, mirrored
from tests.mapfusion.align.map_pairs import landmarks

VARIABLE = "MAPFUSION_LUNARLOC"
FOLDER = Path(os.environ.get(VARIABLE, "none"))
CLUSTER_M, LEAST_DETECTIONS = 0.25, 2
SIGMA_M = 0.03  # of a clustered boulder, per axis
COMMON_M, ENOUGH = 0.25, 15
RIGHT_M, RIGHT_RAD = 0.5, 0.1
SEED = 1
REGISTRATION = Registration(make_aligner("clique"))


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def traverses() -> list[Path]:
    return sorted(FOLDER.glob("traverse_*.csv"), key=lambda path: int(path.stem.split("_")[1]))


def clustered(path: Path) -> LandmarkMap:
    """Return the landmarks of a traverse in the true frame: means of detections close together."""
    csv.field_size_limit(sys.maxsize)
    with path.open() as file:
        seen = [each for row in csv.DictReader(file) for each in ast.literal_eval(row["boulders"])]
    means, counts = list[Float](), list[int]()
    for each in np.array(seen):
        if means:
            away = np.hypot(*(np.array(means)[:, :2] - each[:2]).T)
            k = int(np.argmin(away))
            if away[k] < CLUSTER_M:
                counts[k] += 1
                means[k] = means[k] + (each - means[k]) / counts[k]
                continue
        means.append(each)
        counts.append(1)
    kept = np.array(counts) >= LEAST_DETECTIONS
    return landmarks(np.array(means)[kept], SIGMA_M, name=path.stem)


def moved(own: LandmarkMap, rng: np.random.Generator) -> tuple[LandmarkMap, Float]:
    """Return a map in a frame of its own, and the pose of that frame."""
    T = np.array([*rng.uniform(-10, 10, 2), rng.uniform(-math.pi, math.pi)])
    p = own.position_m.copy()
    p[:, :2] = transform_points(inverse(T), p[:, :2])
    return landmarks(p, SIGMA_M, name=own.name), T


def registered(map_a: LandmarkMap, map_b: LandmarkMap) -> Registered:
    return REGISTRATION.register(map_a, map_b, match(map_a, map_b), np.random.default_rng(0))


def n_common(a: LandmarkMap, b: LandmarkMap) -> int:
    away, _ = scipy.spatial.KDTree(a.position_m[:, :2]).query(b.position_m[:, :2])
    return int(np.count_nonzero(away <= COMMON_M))


def is_right(T_a_b: Float, truth: Float) -> bool:
    turn = abs(math.remainder(T_a_b[2] - truth[2], 2 * math.pi))
    return bool(np.hypot(*(T_a_b - truth)[:2]) <= RIGHT_M and turn <= RIGHT_RAD)


def measure_pairs(maps: list[LandmarkMap]) -> None:
    rng, errors = np.random.default_rng(SEED), list[float]()
    wrong = right = accepted = wrong_accepted = 0
    for a, b in itertools.combinations(maps, 2):
        other, T = moved(b, rng)
        done, common = registered(a, other), n_common(a, b)
        found = done.refined.T_a_b
        errors.append(rms_distance_m(found, T, other.position_m[:, :2]))
        good = is_right(found, T)
        wrong += not good
        wrong_accepted += done.verdict.accepted and not good
        right += good and common >= ENOUGH
        accepted += good and common >= ENOUGH and done.verdict.accepted
        say(
            f"{a.name} {b.name}: {common} common, {done.verdict.status}, log10 NFA "
            f"{done.verdict.log10_false_alarms:.1f}, error {errors[-1]:.3f} m"
        )
    say(
        f"{len(errors)} pairs: {wrong} wrong ({wrong_accepted} accepted); {accepted} of {right} "
        f"right ones with {ENOUGH} or more common landmarks accepted; median error "
        f"{np.median(errors):.3f} m"
    )


def measure_mirrored(maps: list[LandmarkMap], n: int) -> None:
    """Align maps with the mirror images of maps and of parts of maps; half are parts."""
    rng, found, accepted = np.random.default_rng(SEED), list[float](), 0
    for k in range(n):
        a, b = rng.choice(len(maps), 2, replace=k % 3 == 0)
        image = mirrored(maps[b])
        if k % 2:
            away = np.hypot(
                *(image.position_m - image.position_m[rng.integers(len(image))])[:, :2].T
            )
            image = image[np.argsort(away)[: max(12, int(rng.uniform(0.3, 0.8) * len(image)))]]
        verdict = registered(maps[a], moved(image, rng)[0]).verdict
        accepted += verdict.accepted
        found.append(verdict.log10_false_alarms)
    least, low = np.nanquantile(found, [0, 0.1])
    say(f"{n} mirrored: {accepted} accepted; log10 NFA least {least:.1f}, 10 % below {low:.1f}")


def measure_times() -> None:
    """Print the time of one pair, match to verdict, after compilation; half are common."""
    for n in (400, 400, 5000):
        field = made_field(np.random.default_rng(SEED), n, n // 2, noise_m=0.03, planar=True)
        started, wall = time.process_time(), time.perf_counter()
        done = registered(field.map_a, field.map_b)
        used, wall = time.process_time() - started, time.perf_counter() - wall
        error_m = rms_distance_m(done.refined.T_a_b, field.T_a_b, field.map_b.position_m[:, :2])
        memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        say(
            f"{n} x {n}: {used:.2f} s of processor, {wall:.2f} s, {memory_mb:.0f} MB, "
            f"{done.verdict.status}, error {error_m:.3f} m"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mirrored", type=int, default=300)
    parser.add_argument("--times", action="store_true")
    asked = parser.parse_args()
    if asked.times:
        measure_times()
    if not traverses():
        say(f"{VARIABLE} names no folder with traverse_N.csv: skipped")
        return
    maps = [clustered(path) for path in traverses()]
    measure_pairs(maps)
    measure_mirrored(maps, asked.mirrored)


if __name__ == "__main__":
    main()
