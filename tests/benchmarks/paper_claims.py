"""Runs of `paper_as_printed` and `paper`, and the page that compares them with the paper.

    python -m tests.benchmarks.paper_claims RESULTS -o results/reference/paper_claims

Ten seeds of both by the ray caster take half an hour on two cores, two seeds by TinyRenderer as
long again. Finished stages are reused: the same command goes on where it was interrupted. The
results are in RESULTS/RENDERER/NAME-SEED.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from experiments.evaluation.result import run_scenario
from experiments.scenario.loading import load_scenario
from experiments.scenario.suite import one_scenario, parse_seeds
from experiments.studies.paper_claims import SCENARIOS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, help="folder of results and of the store")
    parser.add_argument("--seeds", default="0..9", help="of the runs by the ray caster")
    parser.add_argument("--tiny-seeds", default="0,1", help="of those by TinyRenderer; empty: none")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, required=True)
    asked = parser.parse_args()
    folders = []
    for renderer, seeds in (("raycast", asked.seeds), ("tiny", asked.tiny_seeds)):
        for name in SCENARIOS:
            for seed in parse_seeds(seeds) if seeds else ():
                override = [f"render.renderer={renderer}"]
                scenario = load_scenario(one_scenario(name), override, seed)
                folder = asked.results / renderer / f"{name}-{seed}"
                run_scenario(scenario, asked.results, asked.jobs, lambda *_: None, output=folder)
                folders.append(str(folder))
                sys.stdout.write(f"{folder}\n")
                sys.stdout.flush()
    study = [sys.executable, "-m", "experiments", "study", "paper", *folders]
    study += ["--results", str(asked.results), "-o", str(asked.output)]
    subprocess.run(study, check=True)


if __name__ == "__main__":
    main()
