"""Apply one fault at a time to a copy of the source, and see whether the tests notice.

    python -m tests.seeded_faults [--list] [--only NAME ...]

Says `caught`, `NOT CAUGHT`, or `CANNOT RUN` where the tests fail without any fault, or end
otherwise than by a failed test. Ends with 1 unless all are caught. One fault takes half a minute to
some minutes, most of it compilation.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.pipeline.stage import PACKAGES
from tests.seeded_faults.faults import ROOT, Fault, all_faults

_COPIED = (*PACKAGES, "tests", "scenarios", "pyproject.toml", "README.md", "CONTRIBUTING.md")
_TIME_LIMIT_S = 1800  # a fault may make a loop endless
_NOT_TOLD = {"NUMBA_CACHE_DIR"}  # kernels are the copy's own
_PASSED, _FAILED = 0, 1  # pytest's exit codes; others are no verdict


def copy_source(folder: Path) -> None:
    """Copy all that tests need, without anything compiled."""
    for name in _COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif source.exists():
            shutil.copy2(source, folder / name)


def run_tests(folder: Path, tests: Sequence[str]) -> tuple[int, str]:
    """Exit code and last lines of pytest in the copy."""
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", *tests]
    own = {"PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(folder / "cache")}
    own |= {"PYTHONDONTWRITEBYTECODE": "1"}
    try:
        ended = subprocess.run(
            command,
            cwd=folder,
            env={name: value for name, value in os.environ.items() if name not in _NOT_TOLD} | own,
            capture_output=True,
            text=True,
            timeout=_TIME_LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        return _FAILED, f"took more than {_TIME_LIMIT_S} s"
    return ended.returncode, "\n".join(ended.stdout.splitlines()[-3:])


def verdict(folder: Path, fault: Fault, sound: set[tuple[str, ...]]) -> str:
    """Return True if the fault's tests notice it; `sound` are those that pass without any fault."""
    if fault.tests not in sound:
        code, said = run_tests(folder, fault.tests)
        if code != _PASSED:
            return f"CANNOT RUN ({code}): {said}"
        sound.add(fault.tests)
    path = folder / fault.file
    original = path.read_text(encoding="utf-8")
    try:
        path.write_text(fault.applied(original), encoding="utf-8")
        code, said = run_tests(folder, fault.tests)
    finally:
        path.write_text(original, encoding="utf-8")
    if code == _PASSED:
        return "NOT CAUGHT"
    return "caught" if code == _FAILED else f"CANNOT RUN ({code}): {said}"


def main() -> int:
    """Run the faults that are asked for, or all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--list", action="store_true", help="name the faults, run nothing")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these alone")
    options = parser.parse_args()
    faults = [fault for fault in all_faults() if fault.name in (options.only or [fault.name])]
    if unknown := set(options.only or ()) - {fault.name for fault in faults}:
        parser.error(f"--only: unknown: {', '.join(sorted(unknown))}; see --list")
    if options.list:
        sys.stdout.writelines(f"{fault.name}  {fault.file}\n" for fault in faults)
        return 0
    found, sound = [], set[tuple[str, ...]]()
    with tempfile.TemporaryDirectory(prefix="seeded_faults_") as name:
        folder = Path(name)
        copy_source(folder)
        for fault in faults:
            started_s = time.monotonic()
            found.append(verdict(folder, fault, sound))
            took = f"{time.monotonic() - started_s:.0f} s"
            sys.stdout.write(f"{found[-1]:<11} {fault.name}  {fault.file}  ({took})\n")
            sys.stdout.flush()
    caught = found.count("caught")
    sys.stdout.write(f"{caught} of {len(found)} caught\n")
    return 0 if caught == len(found) else 1


if __name__ == "__main__":
    sys.exit(main())
