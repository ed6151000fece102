"""Copy of a shipped scenario to edit, with its schema and common settings as comments."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from experiments.scenario.loading import load_scenario, schema_text
from experiments.scenario.settings import Recording
from experiments.scenario.suite import shipped_scenario
from experiments.scenario.yaml_files import OWN, lines_of_keys
from mapfusion.errors import InputError
from mapfusion.files import write_whole

# Settings that users change first.
COMMON = (
    "generate.robots",
    "generate.overlap",
    "drive.frames",
    "drive.frame_interval_s",
    "render.renderer",
    "camera.baseline_m",
    "odometry.translation_m_per_sqrt_m",
    "odometry.yaw_rad_per_sqrt_rad",
    "radiometry.sigma_gray",
    "slam.filter.n_particles",
    "slam.filter.proposal",
    "slam.min_count",
    "align.repetitions",
    "merge.aligner",
    "merge.fuser",
    "evaluate.every",
)
_ABOUT = (
    "# Common settings with their present values. To change one, remove the # before it and before",
    "# its section. All settings with their ranges: schema.json, which editors read, or",
    "# `mapfusion scenarios --schema`.",
)
_WIDTH = 100  # characters of a line; longer descriptions are left out
_LEAST_ABOUT = 3  # characters; a shorter description is a symbol of a formula
_BLOCK = re.compile(r"^( *)[\w]+: *(#.*)?$")  # a key whose value is on the lines below it

Key = tuple[str, ...]
_Tree = dict[str, Any]  # sections, and lines of settings


def copy_to_edit(name: str) -> tuple[Path, Path]:
    """Copy a shipped scenario to ./scenarios with the schema that its first line names.

    Returns:
        The paths of the copy and of the schema.

    Raises:
        InputError: the name is unknown, or the file exists.
    """
    source = shipped_scenario(name)
    copy, schema = OWN / source.name, OWN / "schema.json"
    if copy.exists():
        raise InputError(f"{copy}: exists; edit it, or rename it to get the shipped one again")
    for path, text in ((schema, schema_text()), (copy, with_common_settings(source))):
        write_whole(path, lambda file, text=text: file.write_text(text, encoding="utf-8"))
    return copy, schema


def with_common_settings(path: Path) -> str:
    """Return the text of a scenario file, with the settings of `COMMON` that it lacks as comments.

    A setting of a section of the file is below the section's key, the others are at the end.
    """
    text = path.read_text(encoding="utf-8")
    lines, written = text.splitlines(), lines_of_keys(path)
    hints: dict[int, tuple[str, _Tree]] = {}  # indentation and hints below a line; 0: the end
    for key, value, about in _common_values(path):
        if key in written:
            continue
        depth = max(n for n in range(len(key)) if n == 0 or key[:n] in written)
        place = written[key[:depth]] if depth else 0
        block = _BLOCK.match(lines[place - 1]) if place else None
        if place and block is None:
            continue  # a section in brackets has no lines
        indent = f"{block[1]}  " if block else ""
        *sections, last = key[depth:]
        node = hints.setdefault(place, (indent, {}))[1]
        for section in sections:
            node = node.setdefault(section, {})
        node[last] = (value, about)
    for place in sorted(filter(None, hints), reverse=True):
        indent, tree = hints[place]
        lines[place:place] = _commented(tree, indent)
    if 0 in hints:
        lines += ["", *_ABOUT, *_commented(hints[0][1], "")]
    return "\n".join(lines) + "\n"


def _commented(tree: _Tree, indent: str, depth: int = 0) -> Iterator[str]:
    """Yield the lines of sections and settings as comments at an indentation."""
    for name, below in tree.items():
        start = f"{indent}# {'  ' * depth}{name}:"
        if isinstance(below, dict):
            yield start
            yield from _commented(below, indent, depth + 1)
        else:
            value, about = below
            line = f"{start} {json.dumps(value)}"
            with_about = f"{line}  # {about}"
            yield with_about if len(about) >= _LEAST_ABOUT and len(with_about) <= _WIDTH else line


def _common_values(path: Path) -> Iterator[tuple[Key, Any, str]]:
    """Yield key, present value and description of the common settings that a scenario has."""
    scenario, schema = load_scenario(path), json.loads(schema_text())
    present = scenario.resolved()
    kind = "Simulation"
    if isinstance(scenario, Recording):
        kind = "Recording"
    elif scenario.generated is not None:
        kind = "GeneratedScenario"
    for dotted in COMMON:
        key = tuple(dotted.split("."))
        field: dict[str, Any] | None = {"$ref": f"#/$defs/{kind}"}
        value: Any = present
        for part in key:
            field = _section(schema, field).get("properties", {}).get(part) if field else None
            value = value.get(part) if isinstance(value, dict) else None
        if field is not None:
            about = field.get("description", "").partition(". ")[0].partition(";")[0]
            yield key, field.get("default") if value is None else value, about.rstrip(".")


def _section(schema: dict[str, Any], field: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a field's value."""
    reference = field.get("$ref")
    return schema["$defs"][reference.rpartition("/")[2]] if reference else field
