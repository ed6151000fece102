"""Output files: tables as CSV, Markdown and LaTeX, JSON documents, JUnit reports.

Units are in the names. Unknown values are null. A refused estimate is null and has a `reason`. An
infinite median error (most answers have no estimate) is null too.
"""

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.evaluation import tables
from experiments.evaluation.metrics import CheckedScenario
from experiments.evaluation.single_steps import alignment_row
from experiments.pipeline.tables import COVARIANCE, MOTION
from experiments.reports.inspect import unit_of
from experiments.reports.layout import plain
from mapfusion import attitude, landmark_map, robot_log, viewing
from mapfusion.align.alignment import Status
from mapfusion.datasets.log_consistency import Finding
from mapfusion.files import default_of, description_of, write_atomically
from mapfusion.fusion.map_merging import MapAlignment, MergedMaps, advice
from mapfusion.geometry.joint_covariance import RANK
from mapfusion.landmark_map import LandmarkMap
from mapfusion.tables import HEIGHT

_SIGNIFICANT_DIGITS = 4  # in Markdown and LaTeX; CSV files have all digits


def write_tables(folder: Path, tables: dict[str, pd.DataFrame]) -> None:
    """Write each table as NAME.csv, NAME.md and NAME.tex."""
    for name, table in tables.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False))
        write_text(folder / f"{name}.md", to_markdown(table))
        write_text(folder / f"{name}.tex", to_latex(table))


def write_text(path: Path, text: str) -> None:
    """Write a text file as a whole."""
    data = text.encode("utf-8", "backslashreplace")  # text of users may contain lone surrogates
    write_atomically(path, lambda file: file.write_bytes(data))


def to_markdown(table: pd.DataFrame) -> str:
    """Return a Markdown pipe table; pipes inside names are escaped."""
    shown = rounded(table).map(lambda text: text.replace("|", "\\|"))
    alignment = ["right" if name in _numbers(table) else "left" for name in table]
    return shown.to_markdown(index=False, disable_numparse=True, colalign=alignment) + "\n"


def to_latex(table: pd.DataFrame) -> str:
    """Return a LaTeX booktabs table; names are escaped."""
    alignment = "".join("r" if name in _numbers(table) else "l" for name in table)
    return rounded(table).to_latex(index=False, escape=True, column_format=alignment)


def rounded(table: pd.DataFrame) -> pd.DataFrame:
    """Return all cells as text: four significant digits, and a dash for unknown values."""

    def text(value: object) -> str:
        return f"{value:.{_SIGNIFICANT_DIGITS}g}" if isinstance(value, float) else str(value)

    return table.astype(object).map(text).where(table.notna(), "-")


def _numbers(table: pd.DataFrame) -> set[str]:
    return set(table.select_dtypes("number").columns)


JSON_SCHEMA_VERSION = 1
_AXES = ("xx_m2", "xy_m2", "xt_m_rad", "yy_m2", "yt_m_rad", "tt_rad2")  # in the order of COVARIANCE


def publish_json(
    kind: str, content: Mapping[str, Any], is_printed: bool, path: Path | None = None
) -> None:
    """Write the JSON document of a command.

    Args:
        kind: kind of the document.
        content: entries of the document.
        is_printed: if true, the document is printed.
        path: file to write; None for none.
    """
    document = {"schema_version": JSON_SCHEMA_VERSION, "kind": kind} | _json_able(content)
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    if path is not None:
        write_text(path, text)
    if is_printed:
        sys.stdout.write(text)


def _json_able(value: Any) -> Any:
    """Convert a value to types of JSON; NaN and infinite values become None."""
    if isinstance(value, pd.DataFrame):
        return _json_able(value.to_dict("records"))
    if isinstance(value, Mapping):
        return {str(name): _json_able(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_able(item) for item in value]
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


def alignment_document(
    maps: Sequence[Path], seed: int, alignments: Sequence[MapAlignment]
) -> dict[str, Any]:
    """Return the document of `align`: T_a_b of every aligner, and which one to use.

    `note` says why no estimate is accepted, if that is known.
    """
    aligners = []
    for found in alignments:
        row, status, reason = alignment_row(found), found.status, found.reason
        accepted, estimated = found.accepted, row["status"] == Status.ACCEPTED
        refined = {name: row[f"refined_{name}"] for name in MOTION}
        refined |= _covariance([row[name] for name in COVARIANCE])
        refined |= {name: row[name] for name in ("drift_sigma_m", "lower_bound")}
        for name in ("overlap", "heights"):
            refined[name] = None if row[name] is None else row[name].document()
        answer = {"aligner": row["aligner"], "status": status, "reason": reason or None}
        answer |= {"estimated": _motion([row[name] for name in MOTION]) if estimated else None}
        answer |= {"estimated_status": row["status"], "estimated_reason": row["reason"] or None}
        answer |= {"refined": refined if accepted else None}
        numbers = ("n_inliers", "n_correspondences", "log10_false_alarms", "log10_evidence")
        numbers += ("n_confirmed", "n_contradicted", "elapsed_s")
        aligners.append(answer | {name: row[name] for name in numbers})
    any_accepted = any(found.accepted for found in alignments)
    note = "" if any_accepted else alignments[0].cause
    head = {"map_a": maps[0], "map_b": maps[1], "seed": seed, "note": note or None}
    head |= {"advice": advice(alignments)}
    return {**head, "aligners": aligners}


def map_document(
    paths: Sequence[Path],
    log: Path,
    seed: int,
    landmarks: LandmarkMap,
    findings: Sequence[Finding] = (),
) -> dict[str, Any]:
    """Return the document of `slam`: the maps and the findings about the log.

    `paths` are those of the filter's map and, if there is one, of the smoothed map.
    """
    observed = [
        {
            "check": finding.kind,
            "iteration": finding.frame if finding.frame >= 0 else None,
            "finding": finding.text,
        }
        for finding in findings
    ]
    found = {"robot": landmarks.name, "n_landmarks": len(landmarks), "findings": observed}
    smoothed = paths[1] if len(paths) > 1 else None
    return {"log": log, "seed": seed, "map": paths[0], "smoothed_map": smoothed} | found


def fusion_document(
    paths: Sequence[Path], seed: int, merged: MergedMaps, maps: Sequence[Path]
) -> dict[str, Any]:
    """Return the document of `merge`: the largest fused map, and the others.

    `lower_bound` is true if the covariances do not contain all errors that the landmarks of a map
    share. `note` says what the verdict on a used alignment could not test; null if nothing.
    `T_first_map` is null for a map that was left out. Without `paths` nothing was merged, and `map`
    is null.
    """
    pairs = [
        {"map_a": maps[a], "map_b": maps[b], "merged": not reason, "reason": reason or None}
        | {"note": None if reason else merged.notes.get((a, b))}
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
            k = len(sources)
            if fused.middle_covariance is not None and motion:
                of_middle = fused.middle_covariance[k][np.triu_indices(3)]
                source["covariance_at_middle"] = _covariance(of_middle)
            if fused.height_m is not None and motion:
                source["height_m"] = fused.height_m[k]
            sources.append(source | {"reason": reason})
        several = int(((fused.parents >= 0).sum(axis=1) > 1).sum())
        found = {"n_landmarks": len(fused.landmarks), "n_fused_of_several": several}
        found |= {"duplicate_share": fused.duplicate_share}
        found |= {"lower_bound": merged.is_lower_bound(fused)}
        documents.append({"map": path, "maps": sources} | found)
    first, *others = documents
    if not paths:
        first |= {"n_landmarks": 0, "n_fused_of_several": 0, "duplicate_share": None}
    head = {"seed": seed, "aligner": merged.aligner, "advice": merged.advice}
    return {**head, **first, "others": others, "pairs": pairs}


def check_document(checks: Sequence[CheckedScenario]) -> dict[str, Any]:
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


def write_junit(path: Path, checks: Sequence[CheckedScenario]) -> None:
    """Write one suite for each scenario, with a case for each run and for each expectation."""
    root = ET.Element("testsuites", name="mapfusion check")
    for check in checks:
        suite = ET.SubElement(root, "testsuite", name=plain(check.scenario))
        seeds = list(check.elapsed_s)
        for seed in seeds or [None]:
            elapsed_s = check.elapsed_s.get(seed, 0.0) if seed is not None else 0.0
            case = _add_case(
                suite, check, "run" if seed is None else f"run, seed {seed}", elapsed_s
            )
            if check.error and seed == (seeds[-1] if seeds else None):
                ET.SubElement(case, "error", message=plain(check.error))
            elif seed is None:
                ET.SubElement(case, "skipped", message="another scenario cannot be read")
            elif seed in check.unmerged:
                ET.SubElement(case, "failure", message=check.unmerged[seed].text)
        for outcome in check.outcomes:
            case = _add_case(suite, check, outcome.metric)
            by_seed = ", ".join(f"{seed}: {value:.4g}" for seed, value in outcome.per_seed.items())
            text = f"{outcome.value:.6g}, expected {outcome.bound_text}; by seed {by_seed}"
            if outcome.passed:
                ET.SubElement(case, "system-out").text = text
            else:
                ET.SubElement(case, "failure", message=text)
        _add_totals(suite)
    _add_totals(root)
    document = ET.ElementTree(root)
    write_atomically(
        path, lambda file: document.write(file, encoding="utf-8", xml_declaration=True)
    )


def _add_case(
    suite: ET.Element, check: CheckedScenario, name: str, elapsed_s: float = 0.0
) -> ET.Element:
    """Add a test case to a suite."""
    named = {"classname": plain(check.scenario), "name": name}
    return ET.SubElement(suite, "testcase", named, time=f"{elapsed_s:.3f}")


def _add_totals(node: ET.Element) -> None:
    """Count cases, failures and seconds of the elements below."""
    cases = list(node.iter("testcase"))
    node.set("tests", str(len(cases)))
    for plural, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
        node.set(plural, str(sum(case.find(tag) is not None for case in cases)))
    node.set("time", f"{sum(float(case.get('time', 0)) for case in cases):.3f}")


PAGE = Path(__file__).parents[1] / "docs" / "formats.md"
TABLES_BEGIN = "<!-- From here on made by `python -m experiments.reports.export` -->"
_OPEN = {
    "A map: one file, `NAME.parquet`, `NAME.csv` or `NAME.ply`": landmark_map.LANDMARKS,
    "A map's joint covariance: `NAME.joint.parquet` beside it, one row a landmark": (
        landmark_map.joint_schema(RANK)
    ),
    "A map's viewing evidence: `NAME.viewing.parquet` beside it, one row a landmark": (
        viewing.VIEWING
    ),
    "A map's viewing evidence: `NAME.frames.parquet` beside it, one row a frame": (
        viewing.VIEWED_FRAMES
    ),
    "A log: `frames`, one row an iteration, also of those that saw nothing": robot_log.FRAMES,
    "A log: `observations`, one row a sighting": robot_log.OBSERVATIONS,
    f"A log's odometry covariance: `{robot_log.FILE}`, optional, one row an iteration": (
        robot_log.ODOMETRY_COVARIANCE
    ),
    f"A log's attitude: `{attitude.FILE}`, optional, one row an iteration": attitude.ATTITUDE,
    "A log's truth: `truth_poses`, one row an iteration": robot_log.TRUTH_POSES,
    "A log's truth: `truth_points`, one row an observation, in their order": robot_log.TRUTH_POINTS,
}


def page(text: str) -> str:
    """Return the page with the tables of the schemas; text before the tables is kept."""
    lines = [text.partition(TABLES_BEGIN)[0] + TABLES_BEGIN]
    for title, schema in _OPEN.items():
        lines.append(f"\n## {title}\n")
        lines += ["| column | type | unit | if absent | meaning |", "|---" * 5 + "|"]
        for field in schema:
            default = default_of(field)
            if field.name in HEIGHT:
                absent = "planar, if all four are"
            elif default is None:
                absent = "required"
            else:
                absent = "none" if np.isnan(default) else f"{default:g}"
            lines.append(_column_row(field.name, field.type, absent, description_of(field)))
    lines.append("\n## A result: `RESULT/tables/*.parquet`\n")
    lines.append(
        "`experiments/evaluation/tables.py` describes the rows. All columns are present.\n"
    )
    lines += ["| table | column | type | unit | meaning |", "|---" * 5 + "|"]
    for name, schema in tables.ALL.items():
        cells = ((field.name, field.type, tables.MEANING[field.name]) for field in schema)
        lines += [f"| {name} {_column_row(*each)}" for each in cells]
    return "\n".join([*lines, ""])


def _column_row(name: str, kind: pa.DataType, *more: str) -> str:
    shown = f"{kind.list_size} × {kind.value_type}" if pa.types.is_fixed_size_list(kind) else kind
    return "| " + " | ".join([f"`{name}`", str(shown), unit_of(name), *more]) + " |"


if __name__ == "__main__":
    write_text(PAGE, page(PAGE.read_text(encoding="utf-8")))
