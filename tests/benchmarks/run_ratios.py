"""Time of a run with the ray caster and with TinyRenderer, in alternation.

    python -m tests.benchmarks.run_ratios quick --repetitions 5
    python -m tests.benchmarks.run_ratios quick --repetitions 5 --anew

Seconds by the clock of `mapfusion run`, from an empty store, with as many processes as there are
cores; the two take turns, so that a machine which is now faster and now slower is so for both. A
run's rendering alone is what its processes spent on TinyRenderer's pictures, as if they had shared
that out evenly and had done nothing else. With `--anew` all kernels are compiled by each run,
without it they are there already.
"""

import argparse
import os
import tempfile
from pathlib import Path

from tests.benchmarks.commands import command_s, print_repeated
from tests.benchmarks.where_time_goes import seconds

_RENDERERS = ("raycast", "tiny")


def rendering_s(results: Path) -> float:
    """Seconds by the clock that rendering alone takes all cores, of a finished run's pictures."""
    (result,) = (path.parent for path in results.glob("*/tables"))
    return float(seconds([result])["rendering"]) / (os.cpu_count() or 1)


def once(scenario: str, anew: bool) -> dict[str, float]:
    """One run with each renderer: seconds and ratios by name."""
    took: dict[str, float] = {}
    for renderer in _RENDERERS:
        with tempfile.TemporaryDirectory() as folder:
            results, kernels = Path(folder) / "results", Path(folder) / "kernels"
            words = ("run", scenario, "--set", f"render.renderer={renderer}")
            took[f"{renderer}, s"] = command_s(
                (*words, "--results", str(results)), kernels if anew else None
            )
            if renderer == "tiny":
                took["tiny's rendering alone, s"] = rendering_s(results)
    took["raycast over tiny"] = took["raycast, s"] / took["tiny, s"]
    took["tiny over its rendering"] = took["tiny, s"] / took["tiny's rendering alone, s"]
    return took


def main() -> None:
    """Print each repetition as it ends, then medians with the least and the greatest."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", help="File or name.")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--anew", action="store_true", help="Compile all kernels in each run.")
    asked = parser.parse_args()
    print_repeated(lambda: once(asked.scenario, asked.anew), asked.repetitions)


if __name__ == "__main__":
    main()
