"""Many generated scenarios, each run by the command itself in a process of its own.

    python -m tests.benchmarks.generated_runs --runs 150 --seed 44 --jobs 16 -o FOLDER

Every generated scenario of `scenarios/` is run with worlds, team sizes, cameras and lengths drawn
from `--seed`. A run is `good` if it ends with exit code 0 and all its tables, and `mapfusion
report` can show it. It is `refused` if it ends with exit code 2 and a line that names a setting of
`generate`, which such a draw may make impossible. All else is a `failure`: a defect, "run again", a
traceback, a robot that does not get through, or a run that takes longer than `--limit-s`.

FOLDER/runs.jsonl gets a line as each run ends. The same command goes on where an interrupted one
was; a failed run keeps its results in FOLDER/NUMBER, and `--only NUMBER` runs it again.
Longer runs begin first, so that all processes are busy to the end. `--shortest-first` gives figures
early on a small machine.
"""

import argparse
import contextlib
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NoReturn

from experiments.evaluation.tables import ALL
from experiments.scenario.yaml_files import read_mapping

REPOSITORY = Path(__file__).parents[2]
# The suite's references use seeds below 1000, as do the tests.
FIRST_SEED, LAST_SEED = 10_000, 2**32 - 1
_SIZES = ((320, 240), (640, 480))
_ROBOTS, _FRAMES = (2, 5), (60, 300)
_ROOMS_A_SIDE = (2, 5)
_OWN_PLAN_SHARE = 0.5  # of the runs that keep the scenario's own plan
_KILLED = -signal.SIGKILL
_LAST_LINES = 5  # of what a failed run wrote, kept in its line
# The command writes these lines where it refuses a generated world that nobody could drive.
_REFUSED = re.compile(r"scenarios/\w+\.yaml: generate\.\w+: ")
_DEFECT = re.compile(r"run again|Traceback|internal error|defect", re.IGNORECASE)


@dataclass(frozen=True)
class Drawn:
    """One run to make.

    Attributes:
        number: among those of one `--seed`.
        words: what follows `mapfusion`, but for the folder of results.
        cost: pictures by pixels, to begin with the longest.
    """

    number: int
    words: tuple[str, ...]
    cost: int


@dataclass(frozen=True)
class Ended:
    """Ending of a run: one line of runs.jsonl.

    Attributes:
        number: see `Drawn`.
        kind: good, refused or failure.
        code: exit code, negative for a signal.
        elapsed_s: by the clock.
        said: the last lines on stderr, of a good run those that are warnings.
        command: what reproduces it.
    """

    number: int
    kind: str
    code: int
    elapsed_s: float
    said: list[str]
    command: str


def generated_scenarios() -> list[Path]:
    """The suite's scenarios whose world and routes a seed draws."""
    files = sorted((REPOSITORY / "scenarios").glob("*.yaml"))
    return [path.relative_to(REPOSITORY) for path in files if "generate" in read_mapping(path)]


def drawn_runs(seed: int, n_runs: int) -> list[Drawn]:
    """Runs of all generated scenarios in turn; a run is the same whatever their number."""
    kinds = generated_scenarios()
    return [_drawn(seed, number, kinds[number % len(kinds)]) for number in range(n_runs)]


def _drawn(seed: int, number: int, scenario: Path) -> Drawn:
    rng = random.Random(f"{seed}/{number}")
    width, height = rng.choice(_SIZES)
    robots, frames = rng.randint(*_ROBOTS), rng.randint(*_FRAMES)
    settings = {
        "generate.robots": robots,
        "drive.frames": frames,
        "camera.width_px": width,
        "camera.height_px": height,
        "camera.focal_px": 577.0 * width / 640,  # the same field of view
    }
    if rng.random() > _OWN_PLAN_SHARE:
        settings["generate.rooms_a_side"] = rng.randint(*_ROOMS_A_SIDE)
        settings["generate.doors_a_room"] = rng.randint(1, 2)
    words = ["run", str(scenario), "--seed", str(rng.randint(FIRST_SEED, LAST_SEED))]
    for key, value in settings.items():
        words += ["--set", f"{key}={value}"]
    return Drawn(number, (*words, "--jobs", "1"), robots * frames * width * height)


class Runner:
    """Runs commands at the same time and ends them all when it is told to."""

    def __init__(self, folder: Path, limit_s: float) -> None:
        self._folder, self._limit_s = folder, limit_s
        self._running: set[subprocess.Popen[str]] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def run(self, drawn: Drawn) -> Ended | None:
        """Run one scenario and its report; None if all were told to end meanwhile."""
        results, started = self._folder / f"{drawn.number:04d}", time.monotonic()
        words = [*drawn.words, "--results", str(results)]
        code, err = self._command(words)
        kind, said = classified(code, err, results)
        if kind == "good":
            (result,) = _result_folders(results)
            code, err = self._command(["report", str(result)])
            if code:
                kind, said, words = "failure", err.splitlines(), ["report", str(result)]
        if self._stopped:
            return None
        if kind != "failure":
            shutil.rmtree(results, ignore_errors=True)
        elapsed_s = round(time.monotonic() - started, 1)
        shown = shlex.join(["mapfusion", *words])
        return Ended(drawn.number, kind, code, elapsed_s, said, shown)

    def _command(self, words: Sequence[str]) -> tuple[int, str]:
        """Exit code and stderr of `mapfusion WORDS`."""
        with self._lock:
            if self._stopped:
                return _KILLED, ""
            process = subprocess.Popen(
                [sys.executable, "-m", "experiments", *words],
                cwd=REPOSITORY,
                env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                start_new_session=True,
            )
            self._running.add(process)
        late = ""
        try:
            _, err = process.communicate(timeout=self._limit_s)
        except subprocess.TimeoutExpired:
            _end(process)
            _, err = process.communicate()
            late = f"\nkilled after {self._limit_s:g} s"
        with self._lock:
            self._running.discard(process)
        return process.returncode, err + late

    def stop(self) -> None:
        """End all commands; what they finished is kept."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                _end(process)


def _end(process: subprocess.Popen[str]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def classified(code: int, err: str, results: Path) -> tuple[str, list[str]]:
    """`good`, `refused` or `failure`, and the lines of stderr that tell why.

    Args:
        code: of the command's exit.
        err: all it wrote to stderr.
        results: where its tables are to be.
    """
    lines = [line for line in err.splitlines() if line.strip()]
    last = lines[-_LAST_LINES:]
    if code == 0:
        missing = _missing(results)
        if missing or any(_DEFECT.search(line) for line in lines):
            return "failure", [*last, *missing]
        return "good", [line for line in lines if "warning" in line.lower()]
    if code == 2 and lines and _REFUSED.search(lines[-1]):
        return "refused", lines[-1:]
    return "failure", last


def _missing(results: Path) -> list[str]:
    """Return the names of what a finished run has not written."""
    folders = _result_folders(results)
    if len(folders) != 1:
        return [f"{results}: holds {len(folders)} results, not one"]
    written = {path.stem for path in (folders[0] / "tables").iterdir()}
    return [f"no table {name}" for name in ALL if name not in written]


def _result_folders(results: Path) -> list[Path]:
    return [path.parent for path in results.glob("*/tables")]


def _known(file: Path) -> dict[int, Ended]:
    """The runs that ended before, by number; a line that was cut off is none."""
    known = {}
    for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else ():
        try:
            ended = Ended(**json.loads(line))
        except (ValueError, TypeError):
            continue
        known[ended.number] = ended
    return known


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def run_all(
    wanted: Sequence[Drawn], folder: Path, jobs: int, limit_s: float, shortest_first: bool = False
) -> list[Ended]:
    """Run those that have not ended before; give all that have ended."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "runs.jsonl"
    known = _known(file)
    left = [each for each in wanted if each.number not in known]
    left.sort(key=lambda each: each.cost, reverse=not shortest_first)
    runner = Runner(folder, limit_s)
    signal.signal(signal.SIGTERM, _interrupt)
    with ThreadPoolExecutor(jobs) as pool, file.open("a", encoding="utf-8") as lines:
        try:
            for future in as_completed([pool.submit(runner.run, each) for each in left]):
                ended = future.result()
                if ended is None:
                    continue
                known[ended.number] = ended
                lines.write(json.dumps(asdict(ended)) + "\n")
                lines.flush()
                _say(
                    f"{len(known)}/{len(wanted)}: {ended.number} {ended.kind}, {ended.elapsed_s} s"
                )
                if ended.kind == "failure":
                    _say("\n".join(f"    {line}" for line in (*ended.said, ended.command)))
        except KeyboardInterrupt:
            runner.stop()
            _say("interrupted; the same command goes on from here")
    return [known[each.number] for each in wanted if each.number in known]


def main() -> None:
    """Run them, then print how many ended how; exit code 1 if there is a failure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0, help="Draws the runs.")
    parser.add_argument("--jobs", type=int, default=1, help="Runs at a time, one core each.")
    parser.add_argument("--limit-s", type=float, default=3600, help="A longer run is a failure.")
    parser.add_argument("--shortest-first", action="store_true", help="Begin with short runs.")
    parser.add_argument("--only", type=int, help="Number of the one run to make, again if need be.")
    parser.add_argument("-o", "--output", type=Path, required=True, help="Folder.")
    asked = parser.parse_args()
    folder = asked.output.resolve() / f"seed-{asked.seed}"
    wanted = drawn_runs(asked.seed, asked.runs)
    if asked.only is not None:
        wanted, folder = drawn_runs(asked.seed, asked.only + 1)[asked.only :], folder / "again"
        shutil.rmtree(folder, ignore_errors=True)
    ended = run_all(wanted, folder, asked.jobs, asked.limit_s, asked.shortest_first)
    kinds = Counter(each.kind for each in ended)
    for each in ended:
        if each.kind != "good":
            _say(f"{each.number} {each.kind}: {' | '.join(each.said[-1:])}\n    {each.command}")
    for text, n in Counter(
        line for each in ended if each.kind == "good" for line in each.said
    ).items():
        _say(f"{n} good runs said: {text}")
    told = ", ".join(f"{kinds[kind]} {kind}" for kind in ("good", "refused", "failure"))
    _say(f"{len(ended)} of {len(wanted)} runs ended: {told}")
    sys.exit(1 if kinds["failure"] or len(ended) < len(wanted) else 0)


if __name__ == "__main__":
    main()
