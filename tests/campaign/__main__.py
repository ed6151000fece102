"""Random misuse: broken files, scenarios and plug-ins: `python -m tests.campaign --seed 0`.

Broken scenarios, damaged files, flipped bits, plug-ins that misbehave, kills, results that lack
tables, outputs that are inputs, environments that libraries trip over. Says of each part how much
was tried and what was found, and ends with 1 where anything was. `--only PART` for one.
"""

import argparse
import shutil
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from tests.campaign.parts import PARTS, Found, one_share

PROCESSES = 2


def all_shares(names: list[str], seed: int, folder: Path) -> int:
    """Explore these parts, tell of each when it is done; returns the number of faults."""
    started, faults = time.monotonic(), 0
    spawn = get_context("spawn")
    # A new process for each piece: what one changes, no other sees.
    with ProcessPoolExecutor(PROCESSES, spawn, max_tasks_per_child=1) as pool:
        asked: dict[Future[tuple[Found, float]], str] = {}
        for name in names:
            for number in range(PARTS[name].shares):
                own = f"{seed}-{number}"
                asked[pool.submit(one_share, name, own, folder / name / own)] = name
        done: dict[str, list[tuple[Found, float]]] = {name: [] for name in names}
        for future in as_completed(asked):
            name = asked[future]
            done[name].append(future.result())
            if len(done[name]) == PARTS[name].shares:
                faults += tell(name, done[name])
    seen = f"; see {folder}" if faults else ""
    _write(f"{faults} faults of seed {seed} in {time.monotonic() - started:.0f} s{seen}")
    return faults


def tell(name: str, shares: list[tuple[Found, float]]) -> int:
    """Say what came of a part; returns the number of its faults."""
    counts, faults = Counter[str](), list[str]()
    for (counted, found), _ in shares:
        counts.update(counted)
        faults += found
    for what, least in PARTS[name].least.items():
        if counts[what] < least:
            faults.append(f"{counts[what]} {what}, fewer than {least}")
    tried = ", ".join(f"{number} {what}" for what, number in counts.items())
    seconds = sum(each for _, each in shares)
    _write(f"{name}: {tried}; {seconds:.0f} s; {len(faults)} faults", *faults)
    return len(faults)


def _write(*lines: str) -> None:
    sys.stdout.writelines(f"{line}\n" for line in lines)
    sys.stdout.flush()


def main() -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m tests.campaign")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=PARTS, metavar="PART", help=", ".join(PARTS))
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="campaign-"))
    faults = all_shares([asked.only] if asked.only else list(PARTS), asked.seed, folder)
    if not faults:
        shutil.rmtree(folder)
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
