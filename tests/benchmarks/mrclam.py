"""Real recordings: how far off maps of two MRCLAM datasets are, held against a batch smoother.

    python -m tests.benchmarks.mrclam FOLDER

where FOLDER holds `MRCLAM_Dataset7` and `MRCLAM_Dataset9`. Each is imported, calibrated and mapped
with its scenario's settings: a line for FastSLAM's maps of five filter seeds, one for the smoothed
maps and one for the map that `joint` fuses, all after the best rigid fit to the surveyed landmarks.
Logs and results go where the scenarios look for them.
"""

import argparse
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from experiments.evaluation.map_consistency import COVERED, fit_to_truth, relative_consistency
from experiments.scenario.loading import load_scenario
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.fastslam.mapping import build_map
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import transform_points
from mapfusion.landmark_map import LandmarkMap, read_map
from mapfusion.robot_log import read_log

# A batch smoother with labels and a Cauchy loss, robots 1 to 5, metres: GTSAM, not ours.
BATCH_M = {
    7: np.array([0.066, 0.075, 0.083, 0.117, 0.113]),
    9: np.array([0.055, 0.066, 0.056, 0.121, 0.084]),
}
N_SEEDS, N_ROBOTS = 5, 5
REPOSITORY = Path(__file__).parents[2]


def surveyed(folder: Path) -> dict[int, Float]:
    """Places (3,) of the landmarks by their subject's number, which is their label."""
    rows = np.loadtxt(folder / "Landmark_Groundtruth.dat", comments="#")
    return {int(row[0]): np.array([row[1], row[2], 0.0]) for row in rows}


def truth_of(landmarks: LandmarkMap, places: dict[int, Float]) -> Float:
    assert landmarks.label is not None
    return np.array([places[int(label)] for label in landmarks.label])


def rmse_m(landmarks: LandmarkMap, places: dict[int, Float]) -> float:
    """Return the RMSE of all landmarks after the best rigid fit; none is left out."""
    truth, everyone = truth_of(landmarks, places), np.arange(len(landmarks))
    moved = transform_points(np.array(fit_rigid(landmarks.position_m, truth, everyone)), truth)
    off = (landmarks.position_m - moved)[:, :2]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def filtered(asked: tuple[int, Path, int, int]) -> float:
    dataset, folder, robot, seed = asked
    scenario = load_scenario(scenario_path(dataset))
    log = read_log(results(dataset) / f"robot{robot}")
    rng = np.random.default_rng(seed)
    return rmse_m(build_map(log, scenario.slam.filter, rng), surveyed(folder))


def scenario_path(dataset: int) -> Path:
    return REPOSITORY / "scenarios" / f"mrclam{dataset}.yaml"


def results(dataset: int) -> Path:
    return REPOSITORY / "results" / f"mrclam{dataset}"


def run(*words: object) -> None:
    command = [sys.executable, "-m", "experiments", *map(str, words)]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True)


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def say_ratios(name: str, found_m: Float, dataset: int) -> None:
    ratio = found_m / BATCH_M[dataset]
    each = " ".join(f"{value:.3f}" for value in found_m)
    say(
        f"{dataset} {name:9s} {each} m; over batch: median {np.median(ratio):.2f},"
        f" worst {ratio.max():.2f}"
    )


def measure(dataset: int, folder: Path, jobs: int) -> None:
    out, places = results(dataset), surveyed(folder)
    run("import", "mrclam", folder, "-o", out / "raw")
    run("study", "calibrate", *(out / "raw" / f"robot{k + 1}" for k in range(N_ROBOTS)), "-o", out)
    asked = [(dataset, folder, k + 1, s) for k in range(N_ROBOTS) for s in range(N_SEEDS)]
    with ProcessPoolExecutor(jobs) as pool:
        off = np.array(list(pool.map(filtered, asked))).reshape(N_ROBOTS, N_SEEDS)
    say_ratios("FastSLAM", np.median(off, axis=1), dataset)
    say(f"{dataset} FastSLAM  the worst of all seeds {off.max():.3f} m")
    run("run", scenario_path(dataset), "--seed", 0, "--jobs", jobs)
    maps = Path(f"{out}-0") / "maps"
    smoothed = [read_map(maps / f"robot{k + 1}.smoothed.parquet") for k in range(N_ROBOTS)]
    say_ratios("smoothed", np.array([rmse_m(each, places) for each in smoothed]), dataset)
    joint = read_map(maps / "fused.parquet")
    fit = fit_to_truth(joint, truth_of(joint, places))
    found = relative_consistency(joint, fit)
    say(
        f"{dataset} joint     {rmse_m(joint, places):.3f} m, {len(joint)} landmarks, NEES/dof"
        f" {found.nees_per_dof:.2f}, in {COVERED:.0%} {found.coverage_95:.0%}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--datasets", type=int, nargs="+", choices=sorted(BATCH_M), default=[7, 9])
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args()
    for dataset in asked.datasets:
        measure(dataset, (asked.folder / f"MRCLAM_Dataset{dataset}").resolve(), asked.jobs)


if __name__ == "__main__":
    main()
