"""Commands of `mapfusion` by the clock, again and again: what benchmarks of whole runs share."""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path


def command_s(words: Sequence[str], kernels: Path | None = None) -> float:
    """Seconds by the clock of `mapfusion WORDS`; compiled kernels go to a folder if it is given."""
    environment = os.environ | ({} if kernels is None else {"XDG_CACHE_HOME": str(kernels)})
    command = [sys.executable, "-m", "experiments", *words]
    started = time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    took = time.perf_counter() - started
    if done.returncode:
        sys.exit(f"{' '.join(command)}\n{done.stderr}")
    return took


def print_repeated(once: Callable[[], dict[str, float]], repetitions: int) -> None:
    """Print each repetition's figures as it ends, then medians with the least and the greatest."""
    done: list[dict[str, float]] = []
    for _ in range(repetitions):
        done.append(once())
        _say("; ".join(f"{name} {value:.4g}" for name, value in done[-1].items()))
    _say("\n| | median | least | greatest |\n|---|---|---|---|")
    for name in done[0]:
        values = [each[name] for each in done]
        shown = (statistics.median(values), min(values), max(values))
        _say(f"| {name} | {' | '.join(f'{value:.4g}' for value in shown)} |")


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
