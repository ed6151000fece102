"""Calls all kernels with their bounds checked; exit code 1 where a kernel was not reached."""

import importlib
import sys

from experiments.pipeline.stage import SOURCE_ROOT
from tests.bounds.interpreted import interpret_kernels


def main() -> int:
    for package in ("mapfusion", "experiments", "sim"):
        for path in sorted((SOURCE_ROOT / package).rglob("*.py")):
            if "from mapfusion.geometry.numerics" in path.read_text(encoding="utf-8"):
                of_root = path.relative_to(SOURCE_ROOT).with_suffix("")
                importlib.import_module(".".join(of_root.parts))
    calls = interpret_kernels()
    importlib.import_module("tests.bounds.all_kernels").call_all()
    unreached = sorted(name for name, n in calls.items() if n == 0)
    sys.stdout.write(f"{len(calls)} kernels, not reached: {' '.join(unreached) or 'none'}\n")
    return bool(unreached)


if __name__ == "__main__":
    sys.exit(main())
