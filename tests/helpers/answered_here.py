"""The answer of a plug-in without the start of a process."""

import json
import pickle
import warnings
from typing import Any

import numpy as np

from experiments.plugins.isolated_process import alignment_from_json
from experiments.plugins.process_main import MethodRunner
from mapfusion.align.alignment import Alignment
from mapfusion.align.correspondences import Correspondences
from mapfusion.landmark_map import LandmarkMap


def answered_here(
    name: str,
    parameters: dict[str, Any],
    maps: tuple[LandmarkMap, LandmarkMap, Correspondences],
    rng: np.random.Generator,
) -> Alignment:
    """Return the answer as an isolated process would give it, validated twice."""
    runner = MethodRunner()
    assert "error" not in runner.answer("make", name, parameters)
    with warnings.catch_warnings(action="ignore"):  # which are errors in tests alone
        answer = runner.answer("align", pickle.dumps(maps), rng)
    return alignment_from_json(json.loads(json.dumps(answer)), len(maps[2]))
