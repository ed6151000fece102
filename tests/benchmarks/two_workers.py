"""Time of a sweep with one process and with two, in alternation.

    python -m tests.benchmarks.two_workers full --seeds 0..9 --repetitions 1

Seconds by the clock of `mapfusion sweep`, from an empty store; the two take turns, so that a
machine which is now faster and now slower is so for both. Kernels are compiled already: a small
run of the same sweep before warms them. A short sweep gains less than a long one, as one of two
processes is idle while it starts and ends.
"""

import argparse
import tempfile

from tests.benchmarks.commands import command_s, print_repeated

_PROCESSES = {"one process, s": 1, "two processes, s": 2}


def once(suite: str, seeds: str) -> dict[str, float]:
    """The sweep with one process and with two: seconds and their ratio by name."""
    took: dict[str, float] = {}
    for name, processes in _PROCESSES.items():
        with tempfile.TemporaryDirectory() as folder:
            words = ("sweep", suite, "--seeds", seeds, "--jobs", str(processes))
            took[name] = command_s((*words, "--results", folder))
    one, two = took.values()
    return {**took, "one over two": one / two}


def main() -> None:
    """Print each repetition as it ends, then medians with the least and the greatest."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", help="Scenario file, or name or tag of the suite.")
    parser.add_argument("--seeds", default="0..9")
    parser.add_argument("--repetitions", type=int, default=1)
    asked = parser.parse_args()
    once(asked.suite, asked.seeds.split(".")[0])  # compiles the kernels
    print_repeated(lambda: once(asked.suite, asked.seeds), asked.repetitions)


if __name__ == "__main__":
    main()
