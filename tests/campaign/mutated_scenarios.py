"""Broken scenarios: each is refused in short lines, one for each error, or is a scenario.

Scenarios of the suite are mutated, as values and as text; what validates is run where it costs
little (`small_enough`), and ends with a result or with one line as well.
"""

import copy
import json
import math
import multiprocessing
import os
import random
import resource
import signal
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from experiments.evaluation.metrics import load_checked
from experiments.reports.figures import drawing
from experiments.scenario.settings import AnyScenario, Simulation
from experiments.scenario.yaml_files import read_mapping
from mapfusion.errors import MOST_CHARACTERS, InputError
from tests.campaign.parts import Found
from tests.helpers.tiny_scenario import SHORT

SUITE = Path(__file__).parents[2] / "scenarios"
DRAWN = """
schema_version: 1
name: drawn
generate: {overlap: 0.4, robots: 2, world: {wall_height_m: 2.2, texture: {contrast: 0.5}}}
drive: {frames: 9}
"""
NUMBERS = (
    *(0, 1, -1, 2, 3, 7, 0.5, 1e-3, 1e-9, 1e-320, -1e-320, 1e9, -1e9, 1e308, -1e308, 1e18),
    *(2**31, 2**32, 2**63, -(2**63), 10**40, math.nan, math.inf, -math.inf, -0.0, 5e-324),
)
TEXTS = (
    *("", " ", "x", "fused", "oracle", "R1", "../x", "/", "a" * 5000, "a\nb", "\t", "\x1b[31m"),
    *("\x00", "\ud800", "é", "\u202e", "\U0001f600", "null", "1e-3", "nan", "[bold]", "%s{0}", "~"),
)
OTHERS = (None, True, False, [], {}, [[]], {"": None}, [None], {"a": {"b": 1}}, [1, 2, 3], "1")
KEYS = ("", "x", "name", "seed", "frames", "overlap", "1", "é", "self", "__class__", "a.b", "*")
LINES = [
    *("\x00", "\t", "- ", "}", "]", "&a ", "*a ", "!!int ", "!!float ''", "!!timestamp x", "#"),
    *("!!python/object:os.system ", "---\n", "...\n", "%YAML 9.9\n", "? ", ": ", "'", "<<: *a"),
    *("!!set {a, b}", "!!binary x", "2001-01-01", "9" * 5000, "!!bool x", "!!null x", "| \n"),
    '"\\ud800"',
]
_WHOLE_SHARE = 0.15  # of the mutants, are of the suite's own scenarios, too large to be run
CPU_SECONDS_A_RUN = 300  # a tiny run takes three, the first of all a minute more for kernels


def mutated(rng: random.Random, data: Any) -> Any:
    """A copy in which one to three values, keys or items are replaced, added or removed."""
    data = json.loads(json.dumps(data))
    for _ in range(rng.choice([1, 1, 2, 3])):
        nodes = list(_containers(data))
        if nodes:
            _damage(rng, rng.choice(nodes))
    return data


def _containers(node: Any) -> list[Any]:
    """All mappings and lists that hold something."""
    items = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return [*([node] if items else []), *(each for item in items for each in _containers(item))]


def _damage(rng: random.Random, node: Any) -> None:
    place = rng.choice(list(node) if isinstance(node, dict) else range(len(node)))
    value, kind = node[place], rng.random()
    if kind < 0.65:
        node[place] = _other(rng, value)
    elif kind < 0.75:
        del node[place]
    elif kind < 0.85:
        node[place] = [copy.deepcopy(value) for _ in range(rng.choice([2, 3, 200]))]
    elif isinstance(node, dict):
        wrong = rng.choice([*KEYS, f"{place}s", place[1:], place.upper(), rng.choice(TEXTS)])
        node[wrong] = node.pop(place) if kind < 0.95 else _other(rng, value)
    else:
        node.insert(0, _other(rng, value))


def _other(rng: random.Random, value: Any) -> Any:
    """Another value, of the same kind as a rule."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(value, bool | int | float) and rng.random() < 0.1:  # of another type
        return rng.choice([str(value), str(value).lower(), [value], {"a": value}, bool(value)])
    if number and rng.random() < 0.75:
        near = value * rng.choice([-1, 0.1, 0.5, 0.9, 1.1, 2, 10, 1000]) + rng.choice([0, 0, 1])
        whole = int(near) if math.isfinite(near) else 0
        return rng.choice([rng.choice(NUMBERS), near, whole, near / 1])
    if isinstance(value, str) and rng.random() < 0.75:
        return rng.choice([*TEXTS, value[::-1], value * 2, value + rng.choice(TEXTS)])
    return copy.deepcopy(rng.choice([*OTHERS, *NUMBERS, *TEXTS]))


def as_text(rng: random.Random, data: Any) -> bytes:
    """A file of that content; of one in seven the text itself is damaged, a few hold bombs."""
    if rng.random() < 0.01:
        return bomb(rng).encode()
    # JSON is YAML but for its names of NaN and infinity, which YAML's own stand in for
    text = json.dumps(data, indent=rng.choice([None, 1]))
    for name, own in (("-Infinity", "-.inf"), ("Infinity", ".inf"), ("NaN", ".nan")):
        text = text.replace(name, own)
    if rng.random() < 0.3:
        text = f"---\n{text}"  # read as YAML, not as JSON
    if rng.random() < 0.15:
        at = rng.randrange(len(text))
        cut = rng.choice([0, 0, 1, 3, len(text)])
        text = text[:at] + rng.choice(LINES) + text[at + cut :]
    written = text.encode("utf-8", "surrogatepass")
    if rng.random() < 0.02:
        at = rng.randrange(len(written))
        written = written[:at] + rng.randbytes(3) + written[at:]
    return written


def bomb(rng: random.Random) -> str:
    """Text that stands for far more than it is: aliases of aliases, or depth."""
    levels, fan = rng.choice([10, 30, 60]), 10
    use = rng.choice(["[{}]", "{{<<: [{}]}}"])
    lines = ["a0: &a0 {x: 1}"]
    for i in range(1, levels):
        lines.append(f"a{i}: &a{i} " + use.format(", ".join([f"*a{i - 1}"] * fan)))
    depth = rng.choice([60, 1500, 20_000])
    return rng.choice(["\n".join(lines), "[" * depth, "{a: " * depth, "&a [*a]", "- " * depth])


def complaint(load: Callable[[], AnyScenario]) -> tuple[str, AnyScenario | None]:
    """Return the fault in a file's refusal (empty if none), and the scenario if it was read."""
    try:
        return "", load()
    except InputError as error:
        said = str(error)
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:200]}", None
    for line in said.split("\n"):
        if len(line) > MOST_CHARACTERS or not line.isprintable():
            return f"not a line of {MOST_CHARACTERS} characters: {line[:400]!r}", None
    return "", None


def small_enough(scenario: AnyScenario) -> bool:
    """Return True if a run ends within seconds; the campaign runs no others."""
    if not isinstance(scenario, Simulation):
        return True  # its logs are not there
    camera, align = scenario.camera, scenario.align
    pixels = camera.width_px * camera.height_px * scenario.drive.frames * len(scenario.robots)
    return (
        pixels <= 200 * 160 * 120  # frames of the tiny scenario
        and scenario.slam.filter.n_particles <= 500
        and align.repetitions * len(align.aligners) <= 100
        and scenario.evaluate.timing_points * scenario.evaluate.timing_repeats <= 50
        and sum(len(wall.points) for wall in scenario.world.walls) <= 60
    )


def run_fault(path: Path, results: Path, figures: Sequence[str]) -> str:
    """Return the fault in the end of a run with these figures; empty if there is none."""
    screen = results.with_suffix(".txt")
    process = _FRESH.Process(target=_run, args=(path, results, figures, screen))
    process.start()
    process.join()
    code, text = process.exitcode, screen.read_text(encoding="utf-8", errors="replace")
    if code == -signal.SIGXCPU:
        return f"took more than {CPU_SECONDS_A_RUN} s"
    said = [line for line in text.splitlines() if line.startswith("mapfusion: ")]
    # pictures of a few pixels show no corner: the run ends, and says that its maps are empty
    unusable = code == 1 and any("no robot's map can be used" in line for line in said)
    if (code not in {0, 2} and not unusable) or "Traceback" in text:
        return f"ended with {code}: {text[-600:]}"
    if code == 2 and (not said or max(map(len, said)) > MOST_CHARACTERS + 20):
        return f"complained in no line, or in too long ones: {said}"
    return ""


# What takes longest in a tiny run is to import all and to draw all. So each run is in a process
# of its own that has all imported, as nothing else has used it yet; and draws some figures, by lot.
_FRESH = multiprocessing.get_context("forkserver")
_FRESH.set_forkserver_preload(["tests.campaign.mutated_scenarios", "experiments.evaluation.result"])
_FIGURES_A_RUN = 2


def _run(path: Path, results: Path, figures: Sequence[str], screen: Path) -> None:
    """The command, in a process of its own; what it says goes to a file."""
    from experiments.cli import main

    with screen.open("wb") as file:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(file.fileno(), stream.fileno())
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS_A_RUN, CPU_SECONDS_A_RUN + 10))
    drawing.FIGURES = tuple(figures)
    sys.argv = ["mapfusion", "run", str(path), "--jobs", "1", "--results", str(results)]
    main.main()


def explore(seed: str, count: int, runs: int, folder: Path) -> Found:
    """Mutate so often, and on until so many were run; `folder` keeps what fails."""
    rng, seen, faults = random.Random(seed), Counter[str](), []
    (folder / "short.yaml").write_text(SHORT)
    (folder / "drawn.yaml").write_text(DRAWN)
    small = [read_mapping(folder / name) for name in ("short.yaml", "drawn.yaml")]
    whole = [read_mapping(path) for path in sorted(SUITE.glob("*.yaml"))]
    for i in range(2 * count):  # one in twenty can be run
        if i >= count and seen["run"] >= runs:
            break
        path = folder / f"{seed}-{i}.yaml"
        original = rng.choice(whole if rng.random() < _WHOLE_SHARE else small)
        path.write_bytes(as_text(rng, mutated(rng, original)))
        fault, scenario = complaint(lambda path=path: load_checked(path))
        seen.update(["mutants", "valid" if scenario else "refused"])
        if not fault and scenario and seen["run"] < runs and small_enough(scenario):
            seen["run"] += 1
            figures = rng.sample(drawing.FIGURES, _FIGURES_A_RUN)
            fault = run_fault(path, folder / "results", figures)
        if fault:
            faults.append(f"{path}: {fault}")
        else:
            path.unlink()
    return Found(seen, faults)
