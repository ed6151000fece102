"""Documents of `--json`: one for each command, always with the same names.

Units are in the names. Unknown values are null. A refused estimate is null and has a `reason`. An
infinite median error (most answers have no estimate) is null too.
"""

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.metrics import CheckedScenario
from experiments.evaluation.single_steps import MergeResult, final_status
from experiments.pipeline.tables import COVARIANCE, MOTION
from experiments.reports.export import write_text
from mapfusion.align.alignment import Status
from mapfusion.datasets.log_consistency import Finding
from mapfusion.landmark_map import LandmarkMap

SCHEMA_VERSION = 1
_AXES = ("xx_m2", "xy_m2", "xt_m_rad", "yy_m2", "yt_m_rad", "tt_rad2")  # in the order of COVARIANCE


def publish(kind: str, content: Mapping[str, Any], shown: bool, path: Path | None = None) -> None:
    """Print the document of a command if it is shown, and write it if there is a path."""
    document = {"schema_version": SCHEMA_VERSION, "kind": kind} | _json_able(content)
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    if path is not None:
        write_text(path, text)
    if shown:
        sys.stdout.write(text)


def _json_able(value: Any) -> Any:
    """Convert a value to types of JSON; NaN and infinite values become None."""
    if isinstance(value, pd.DataFrame):
        return _json_able(value.to_dict("records"))
    if isinstance(value, Mapping):
        return {str(name): _json_able(held) for name, held in value.items()}
    if isinstance(value, list | tuple):
        return [_json_able(held) for held in value]
    if isinstance(value, np.generic):
        return _json_able(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def _motion(values: Iterable[float]) -> dict[str, float] | None:
    """Return the components of a motion by name; None if one is NaN."""
    found = {str(name): float(x) for name, x in zip(MOTION, values, strict=True)}
    return None if any(map(math.isnan, found.values())) else found


def _covariance(upper: Iterable[float]) -> dict[str, float]:
    """Return the covariance of a motion by name, from its upper half row by row."""
    return {f"cov_{axes}": float(x) for axes, x in zip(_AXES, upper, strict=True)}


def of_alignment(
    maps: Sequence[Path], seed: int, rows: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the document of `align`: T_a_b of every aligner, from one row each."""
    aligners = []
    for row in rows:
        status, reason = final_status(row)
        accepted, estimated = status is Status.ACCEPTED, row["status"] == Status.ACCEPTED
        refined = {name: row[f"refined_{name}"] for name in MOTION}
        refined |= _covariance([row[name] for name in COVARIANCE])
        refined |= {"drift_sigma_m": row["drift_sigma_m"]}
        answer = {"aligner": row["aligner"], "status": status, "reason": reason or None}
        answer |= {"estimated": _motion([row[name] for name in MOTION]) if estimated else None}
        answer |= {"estimated_status": row["status"], "estimated_reason": row["reason"] or None}
        answer |= {"refined": refined if accepted else None}
        numbers = ("n_inliers", "n_correspondences", "log10_false_alarms", "log10_evidence")
        numbers += ("n_confirmed", "n_contradicted", "probability", "elapsed_s")
        aligners.append(answer | {name: row[name] for name in numbers})
    return {"map_a": maps[0], "map_b": maps[1], "seed": seed, "aligners": aligners}


def of_map(
    path: Path, log: Path, seed: int, landmarks: LandmarkMap, findings: Sequence[Finding] = ()
) -> dict[str, Any]:
    """Return the document of `slam`: the map and the findings about the log."""
    observed = [
        {
            "check": finding.kind,
            "iteration": finding.frame if finding.frame >= 0 else None,
            "finding": finding.text,
        }
        for finding in findings
    ]
    found = {"robot": landmarks.name, "n_landmarks": len(landmarks), "findings": observed}
    return {"log": log, "seed": seed, "map": path} | found


def of_fusion(
    paths: Sequence[Path], seed: int, merged: MergeResult, maps: Sequence[Path]
) -> dict[str, Any]:
    """Return the document of `merge`: the largest fused map, and the others.

    `T_first_map` is null for a map that was left out. Without `paths` nothing was merged, and `map`
    is null.
    """
    pairs = [
        {"map_a": maps[a], "map_b": maps[b], "merged": not reason, "reason": reason or None}
        for (a, b), reason in merged.reasons().items()
    ]
    documents: list[dict[str, Any]] = []
    for path, fused in zip(paths or [None], merged.fusion.fused, strict=True):
        reasons = (reason for _, reason in fused.left_out)
        sources = []
        for name, T, S in zip(maps, fused.T_first_map, fused.motion_covariance, strict=True):
            motion = _motion(T)
            covariance = _covariance(S[np.triu_indices(3)]) if motion else None
            reason = None if motion else next(reasons)
            source = {"map": name, "T_first_map": motion, "covariance": covariance}
            sources.append(source | {"reason": reason})
        several = int(((fused.parents >= 0).sum(axis=1) > 1).sum())
        found = {"n_landmarks": len(fused.landmarks), "n_fused_of_several": several}
        found |= {"duplicate_share": fused.duplicate_share}
        documents.append({"map": path, "maps": sources} | found)
    first, *others = documents
    if not paths:
        first |= {"n_landmarks": 0, "n_fused_of_several": 0, "duplicate_share": None}
    return {"seed": seed, **first, "others": others, "pairs": pairs}


def of_checks(checks: Sequence[CheckedScenario]) -> dict[str, Any]:
    """Return the document of `check`: expected and measured values, and failed runs."""
    scenarios = []
    for check in checks:
        outcomes = [
            {"metric": each.metric, "value": each.value, "min": each.bound.min}
            | {"max": each.bound.max, "passed": each.passed, "by_seed": each.per_seed}
            for each in check.outcomes
        ]
        scenario = {
            "scenario": check.scenario,
            "passed": check.passed,
            "error": check.error or None,
        }
        scenario |= {"merged_nothing": list(check.unmerged)}
        scenarios.append(scenario | {"elapsed_s_by_seed": check.elapsed_s, "outcomes": outcomes})
    return {"passed": all(each.passed for each in checks), "scenarios": scenarios}
