"""Descriptors compared on worlds of the suite: matches, alignment, maps, time.

    python -m tests.benchmarks.descriptors -o FOLDER [--seeds 2] [--descriptors usurf sift orb]

Every descriptor gets the same worlds, drives and images (320 x 240 pixels, ray caster, 210 frames)
and the same corners, and every setting but `vision.descriptor` is the default. RANSAC aligns the
filter's maps. FOLDER gets the results of the runs, `runs.csv` with a row for each run,
`descriptors.csv` and `descriptors.md` with a row for each descriptor, and `provenance.json`. Runs
that are there already are not repeated.

Matches are those of the maps at the end. An alignment is right within 0.5 m and 0.1 rad of the
truth. The time is the processor time of one description of 300 corners, apart from the runs.
"""

import argparse
import json
import platform
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from experiments.evaluation.tables import read_provenance
from mapfusion.vision.descriptors import DESCRIBERS, NamedDescriber

WORLDS = ("quick", "rooms_high", "opposite")
SETTINGS = {
    "render.renderer": "raycast",
    "camera.width_px": 320,
    "camera.height_px": 240,
    "camera.focal_px": 288.5,  # the field of view of the default camera
    "drive.frames": 210,
    "fuse.fusers": "[joint]",
    "expect": "{}",
}
RIGHT_M, RIGHT_RAD = 0.5, 0.1
_N_CORNERS, _REPETITIONS = 300, 20
_DECIMALS = {"matches": 0, "true_share": 3, "error_m": 4, "path_error_m": 4, "describe_ms": 1}


def run(world: str, seed: int, descriptor: str, folder: Path) -> None:
    """Run one world with a descriptor, unless its result is there."""
    if (folder / "provenance.json").is_file():
        return
    settings = SETTINGS | {"vision.descriptor": descriptor}
    words = ["run", world, "--seed", str(seed), "--aligner", "ransac", "--no-figures"]
    for key, value in settings.items():
        words += ["--set", f"{key}={value}"]
    command = [sys.executable, "-m", "experiments", *words, "--jobs", "1", "-o", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):  # 1: an expectation of the scenario is not met
        raise SystemExit(f"{' '.join(words)}: exit code {done.returncode}\n{done.stderr}")


def row_of(folder: Path) -> dict[str, Any]:
    """Return the results of a run at its end."""
    errors = pd.read_parquet(folder / "tables" / "errors.parquet")
    robots = pd.read_parquet(folder / "tables" / "robots.parquet")
    at_end = robots[robots["iteration"] == robots["iteration"].max()]
    found = errors[(errors["aligner"] == "ransac") & (errors["repetition"] == 0)]
    found = found[found["iteration"] == found["iteration"].max()].iloc[0]
    right = found["refined_translation_error_m"] <= RIGHT_M
    right &= found["refined_rotation_error_rad"] <= RIGHT_RAD
    return {
        "landmarks": int(at_end["n_landmarks"].sum()),
        "matches": int(found["n_correspondences"]),
        "true_share": found["n_true"] / max(found["n_correspondences"], 1),
        "true_found": found["n_true"] / max(found["n_common"], 1),
        "right": bool(right),
        "accepted": bool(found["accepted"]),
        "error_m": found["refined_translation_error_m"],
        "path_error_m": at_end["path_error_m"].mean(),
    }


def describe_ms(descriptor: str) -> float:
    """Return the smallest processor time of a description of 300 corners of a 320 x 240 image."""
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)).astype(np.float32), (0, 0), 2)
    image = cv2.normalize(noise, noise, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    uv, scale = rng.uniform(0, [319, 239], (_N_CORNERS, 2)), rng.uniform(1, 6, _N_CORNERS)
    describer, times = NamedDescriber(descriptor), list[float]()
    for _ in range(_REPETITIONS):
        started = time.process_time()
        describer.describe(image, uv, scale)
        times.append(time.process_time() - started)
    return 1e3 * min(times)


def summary(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each descriptor: sums of yes, medians of numbers."""
    rows = []
    for name, own in runs.groupby("descriptor", sort=False):
        rows.append(
            {
                "descriptor": name,
                "runs": len(own),
                "landmarks": int(own["landmarks"].median()),
                "matches": int(own["matches"].median()),
                "true_share": own["true_share"].median(),
                "right": int(own["right"].sum()),
                "accepted": int(own["accepted"].sum()),
                "wrongly_accepted": int((own["accepted"] & ~own["right"]).sum()),
                "error_m": own["error_m"].median(),
                "path_error_m": own["path_error_m"].median(),
                "describe_ms": describe_ms(str(name)),
            }
        )
    return pd.DataFrame(rows).round(_DECIMALS)


def as_markdown(table: pd.DataFrame) -> str:
    """Return a table of GitHub's Markdown."""
    lines = [list(table.columns), ["---"] * len(table.columns)]
    lines += [[str(cell) for cell in row] for row in table.itertuples(index=False)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--worlds", nargs="+", default=WORLDS)
    parser.add_argument("--descriptors", nargs="+", default=list(DESCRIBERS))
    asked = parser.parse_args(words)
    cv2.setNumThreads(1)
    rows, told = [], {}
    for world in asked.worlds:
        for seed in range(asked.seeds):
            for descriptor in asked.descriptors:
                folder = asked.output / world / f"{seed}-{descriptor}"
                run(world, seed, descriptor, folder)
                told = read_provenance(folder / "provenance.json")
                about = {"world": world, "seed": seed, "descriptor": descriptor}
                rows.append(about | row_of(folder))
                sys.stdout.write(f"{rows[-1]}\n")
                sys.stdout.flush()
    runs = pd.DataFrame(rows)
    runs.round(_DECIMALS | {"true_found": 3}).to_csv(asked.output / "runs.csv", index=False)
    table = summary(runs)
    table.to_csv(asked.output / "descriptors.csv", index=False)
    (asked.output / "descriptors.md").write_text(as_markdown(table), encoding="utf-8")
    own = {name: told[name] for name in ("source_hash", "libraries", "python") if name in told}
    own |= {"settings": SETTINGS, "worlds": list(asked.worlds), "seeds": list(range(asked.seeds))}
    own |= {"processor": platform.processor() or platform.machine()}
    text = json.dumps(own, indent=1, default=str)
    (asked.output / "provenance.json").write_text(text + "\n", encoding="utf-8")
    sys.stdout.write(as_markdown(table))


if __name__ == "__main__":
    main()
