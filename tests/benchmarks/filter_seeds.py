"""How much FastSLAM's luck matters: each log of a results folder mapped with several filter seeds.

    mapfusion run paper --seed 0 --results R
    python -m tests.benchmarks.filter_seeds paper R/store/log

A line for each log: how far off the most probable particle's path ends up with each seed, in the
frame of its first pose, the worst over the best, and how far off the smoother's path is that starts
from the first seed's; then the medians over the logs.
"""

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.evaluation.map_errors import path_rmse_m
from experiments.evaluation.truth import PathTruth
from experiments.pipeline.stages.pipeline import smoother_parameters
from experiments.pipeline.stages.smooth import log_until
from experiments.pipeline.workers import single_threaded
from experiments.scenario.loading import load_scenario
from mapfusion.attitude import read_attitude
from mapfusion.fastslam.mapping import run_log
from mapfusion.robot_log import read_log, read_odometry_covariance, read_truth
from mapfusion.smoother.smooth import smooth

REPOSITORY = Path(__file__).parents[2]


def off_m(asked: tuple[str, Path, int]) -> tuple[float, float]:
    """Return the path errors of one filter seed; of the smoother too for the first seed."""
    name, folder, seed = asked
    scenario = load_scenario(REPOSITORY / "scenarios" / f"{name}.yaml")
    slam, log, rng = scenario.slam, read_log(folder), np.random.default_rng(seed)
    end = len(log) - 1
    told = read_odometry_covariance(folder), read_attitude(folder)
    *_, last = run_log(log, slam.filter, rng, [end], slam.min_count, *told)
    truth, path = PathTruth.of(read_truth(folder)).T_map_robot, last.slam.best_path()
    if seed:
        return path_rmse_m(path, truth), np.nan
    noisy = log_until(log, end, slam.filter.noise_floor_m)
    settings = replace(smoother_parameters(scenario), odometry_covariance=told[0])
    smoothed = smooth(noisy, last.slam.best_associations(), path, settings)
    return path_rmse_m(path, truth), path_rmse_m(smoothed.estimate.path, truth)


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", help="whose filter settings hold: a name of the suite")
    parser.add_argument("logs", type=Path, help="folder of logs with their truth")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args()
    logs = sorted(path for path in asked.logs.resolve().iterdir() if path.is_dir())
    runs = [(asked.scenario, log, seed) for log in logs for seed in range(asked.seeds)]
    with ProcessPoolExecutor(asked.jobs, initializer=single_threaded) as pool:
        off = np.array(list(pool.map(off_m, runs))).reshape(len(logs), asked.seeds, 2)
    filtered, smoothed = off[:, :, 0], off[:, 0, 1]
    spread = filtered.max(axis=1) / filtered.min(axis=1)
    for log, own, ratio, batch in zip(logs, filtered, spread, smoothed, strict=True):
        each, name = " ".join(f"{1e3 * value:.1f}" for value in own), read_log(log).robot
        say(f"{log.name} {name} {each} mm, worst over best {ratio:.2f}; smoothed {1e3 * batch:.1f}")
    over = np.median(filtered / smoothed[:, None], axis=0)
    each = " ".join(f"{value:.2f}" for value in over)
    say(f"medians over {len(logs)} logs: worst over best {np.median(spread):.2f};")
    say(f"FastSLAM over smoother {each}, of all {np.median(filtered / smoothed[:, None]):.2f}")


if __name__ == "__main__":
    main()
