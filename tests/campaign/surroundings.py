"""Results that lack tables, files of other versions, outputs that are inputs, and environments.

Each command ends with its work done or with lines that name the file or the variable.
"""

import json
import os
import random
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from experiments.cli.main import app
from experiments.evaluation import tables
from experiments.reports.report.document import contents_of
from experiments.reports.result_export import export_result
from experiments.studies.comparison import compare
from experiments.studies.run_tables import find_runs
from mapfusion.errors import InputError
from tests.campaign.parts import Found

READERS: dict[str, Callable[[Path], object]] = {
    "report": contents_of,
    "export": lambda result: export_result(result, "tum"),
    "statistics": find_runs,
    "compare": lambda result: compare(result, result),
}
_VERSIONS = (99, 2, 0, -1, "1", 1.5, True, None, [1])
_THREADS = ("", "abc", "0", "-1", "4,2", "2.5", "9" * 40, " 2", "0x2", "1e1")
_FOLDERS = ("/nonexistent/x", "/dev/null", "/proc/x", "relative", "")
_VALUES = {
    **dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMEXPR_MAX_THREADS"), _THREADS),
    **dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), _THREADS),
    **dict.fromkeys(("HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR", "NUMBA_CACHE_DIR"), _FOLDERS),
    "MPLBACKEND": ("", "nope", "TkAgg", "module://nope"),
    "COLUMNS": ("", "0", "-1", "abc", "1" * 30),
}
_SECONDS = 120  # of one command
_OUTPUTS = 40  # that are drawn
_COLUMNS = "x_m,y_m,cov_xx_m2,cov_xy_m2,cov_yy_m2,label"
_MAP = "\n".join([_COLUMNS, *(f"{k},{k * k % 7},1e-4,0,1e-4,{k}" for k in range(20)), ""])
# Words of a command whose output, added at the end, must be none of the files that it reads.
_WRITERS: dict[str, tuple[str, ...]] = {
    "merge": ("a.csv", "b.csv"),
    "align": ("a.csv", "b.csv"),
    "slam": ("log",),
    "export": ("result", "--format", "tum"),
    "report": ("result",),
}


def written(folder: Path) -> Path:
    """Write a result of tables without rows, which says what it holds."""
    for name in tables.ALL:
        tables.write(tables.table_path(folder, name), name, [])
    about = {"schema_version": 1, "tables": sorted(tables.ALL)}
    for name, content in {
        "scenario": {"schema_version": 1, "name": "made", "seed": 0},
        "world": {"schema_version": 1},
        "provenance": about,
    }.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    return folder


def explore(seed: str, n_environments: int, folder: Path) -> Found:
    """Delete each table, change each version, and draw so many environments."""
    rng, counts, faults = random.Random(seed), Counter[str](), list[str]()
    result = written(folder / "result")
    for name in tables.ALL:
        path = tables.table_path(result, name)
        whole = path.read_bytes()
        path.unlink()
        for command, read in READERS.items():
            counts["tables deleted"] += 1
            faults += _unnamed(f"{command} without {name}", lambda r=read: r(result), path)
        path.write_bytes(whole)
    for name in ("scenario", "provenance"):
        path = result / f"{name}.json"
        whole = path.read_text()
        for version in _VERSIONS:
            path.write_text(json.dumps(json.loads(whole) | {"schema_version": version}))
            counts["versions"] += 1
            told = f"{name} of version {version!r}"
            faults += _unnamed(told, lambda: contents_of(result), path)
        path.write_text(whole)
    for _ in range(_OUTPUTS):
        counts["outputs"] += 1
        faults += _overwritten(rng, folder)
    for _ in range(n_environments):
        own = {name: rng.choice(_VALUES[name]) for name in rng.sample(sorted(_VALUES), 2)}
        counts["environments"] += 1
        faults += _ended_wrongly(own, folder)
    return Found(counts, faults)


def _overwritten(rng: random.Random, folder: Path) -> list[str]:
    """Return the fault, if any, of a command that is told to write to one of its inputs."""
    for name in ("a.csv", "b.csv", "log/frames.csv", "log/observations.csv"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(_MAP)
    command = rng.choice(sorted(_WRITERS))
    words = _WRITERS[command]
    inputs = [folder / word for word in words if (folder / word).exists()]
    output = rng.choice(inputs)
    if output.is_dir() and command != "export":
        output = rng.choice(sorted(path for path in output.rglob("*") if path.is_file()))
    kind = rng.choice(["same", "relative", "link", "hard link"])
    if kind == "relative":
        output = Path(os.path.relpath(output))
    elif kind == "link" or output.is_dir():
        link = folder / f"link{output.suffix}"
        link.unlink(missing_ok=True)
        link.symlink_to(output)
        output = link
    elif kind == "hard link":
        (folder / f"hard{output.suffix}").unlink(missing_ok=True)
        os.link(output, folder / f"hard{output.suffix}")
        output = folder / f"hard{output.suffix}"
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    called = [command, *(str(folder / w) if (folder / w).exists() else w for w in words)]
    what = f"{command} with its output over an input ({kind}, {output.name})"
    try:
        app([*called, "-o", str(output)], prog_name="mapfusion", standalone_mode=False)
        faults = [f"{what}: was not refused"]
    except InputError as error:
        is_right = re.search("is an input|is a file of|holds|would replace|ends in", str(error))
        faults = [] if is_right else [f"{what}: refused for another reason: {error}"]
    except Exception as error:
        faults = [f"{what}: {type(error).__name__} {error}"]
    after = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    return faults if before == after else [*faults, f"{what}: files changed"]


def _unnamed(what: str, read: Callable[[], object], path: Path) -> list[str]:
    """The fault, if any, of a reader that has to refuse a file by its name."""
    try:
        read()
    except InputError as error:
        return [] if path.name in str(error) else [f"{what}: told without its file: {error}"]
    except Exception as error:
        return [f"{what}: {type(error).__name__} {error}"]
    return [f"{what}: was not noticed"]


def _ended_wrongly(own: dict[str, str], folder: Path) -> list[str]:
    """The fault, if any, of a command under these variables."""
    # imports all that others do, and compiles nothing where there is no folder for kernels
    command = [sys.executable, "-m", "experiments", "scenarios", "--aligners"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **own}
    try:
        ended = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, timeout=_SECONDS
        )
    except subprocess.TimeoutExpired:
        return [f"{own}: took more than {_SECONDS} s"]
    said = ended.stderr.decode(errors="replace")
    is_right = ended.returncode in {0, 1, 2} and "Traceback" not in said
    return [] if is_right else [f"{own}: ended with {ended.returncode}: {said[-400:]}"]
