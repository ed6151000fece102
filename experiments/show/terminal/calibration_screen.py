"""What `calibrate` shows."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from ruamel.yaml import YAML

from experiments.judge.user_calibration import filter_settings
from experiments.show.terminal.layout import columns, print_frame, print_lines
from mapfusion.smoother.calibrate import Calibration
from mapfusion.smoother.noise_levels import LEVELS

_CONSTANTS = ("distance", "turn", "late_turn", "bias_rad_per_m", "in_place")
_TITLES = ("distance\n%", "turn\n%", "late turn\n%", "bias\nmrad/m", "in place\n%")
_UNITS = (100.0, 100.0, 100.0, 1000.0, 100.0)
_SHOWN = columns("", robot="robot") | columns(">", **dict(zip(_CONSTANTS, _TITLES, strict=True)))


def calibration_rows(calibration: Calibration) -> list[dict[str, Any]]:
    """Each robot's constants with their standard errors."""
    return [
        {"robot": each.robot}
        | dict(zip(_CONSTANTS, each.error.constants.tolist(), strict=True))
        | {
            f"{name}_sigma": float(sigma)
            for name, sigma in zip(_CONSTANTS, each.standard_errors, strict=True)
        }
        for each in calibration.robots
    ]


def document(calibration: Calibration, written: Sequence[Path]) -> dict[str, Any]:
    """What `--json` prints."""
    errors = zip(LEVELS, calibration.relative_errors, strict=True)
    return {
        "robots": calibration_rows(calibration),
        "settings": filter_settings(calibration),
        "relative_errors": {name: float(value) for name, value in errors},
        "n_rounds": calibration.n_rounds,
        "settled": calibration.settled,
        "logs": [str(path) for path in written],
    }


def print_calibration(calibration: Calibration, written: Sequence[Path]) -> None:
    """Constants, levels, and the section for a scenario."""
    rows = []
    for each in calibration.robots:
        values = zip(each.error.constants, each.standard_errors, _UNITS, strict=True)
        texts = (f"{unit * value:+.1f} ± {unit * sigma:.1f}" for value, sigma, unit in values)
        rows.append({"robot": each.robot} | dict(zip(_CONSTANTS, texts, strict=True)))
    print_frame(
        pd.DataFrame(rows),
        _SHOWN,
        "What the odometry has to be corrected by",
        "late turn: share of the turn before that is only made now; in place: turns on the spot,\n"
        "beside those while driving",
    )
    if not calibration.settled:
        n_rounds = calibration.n_rounds
        print_lines([f"  not settled: constants or levels still change after {n_rounds} rounds"])
    print_lines([f"  {path}: corrected" for path in written])
    if written:
        print_lines(["For a scenario with the corrected logs:"])
        YAML().dump(filter_settings(calibration), sys.stdout)
