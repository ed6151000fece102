"""Scenario suite: shipped scenarios and those in ./scenarios, found by path, name or tag.

A scenario in ./scenarios replaces the shipped scenario of the same name. A copy of a shipped
scenario names its schema and lists common settings as comments.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.scenario.yaml_files import OWN, SHIPPED, lines_of_keys, read_mapping
from mapfusion.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from experiments.scenario.settings import AlignerEntry, Scenario

_TAGS = re.compile(r"^tags: \[([^]\n]+)\]", re.MULTILINE)
SUFFIXES = {".yaml", ".yml", ".json"}  # a JSON file is YAML too: a result's scenario.json


def scenarios_of(names_or_tags: Sequence[str | Path], folder: Path | None = None) -> list[Path]:
    """Return the scenario files of some names or tags, in this order and without repetition.

    Args:
        names_or_tags: paths, names of scenarios, or tags. A tag stands for all scenarios that have
            it, sorted by file name.
        folder: where names and tags are searched; the suite by default.

    Raises:
        InputError: a name is unknown; the message lists the known names and tags.
    """
    found: list[Path] = []
    for wanted in names_or_tags:
        path = Path(wanted)
        if path.suffix in SUFFIXES or len(path.parts) > 1 or path.is_file():
            found.append(path)
            continue
        files, word = _files(folder), str(wanted)
        if any(path.stem == word for path in files):
            # reading all files is slow: read only those that contain the name
            files = [path for path in files if path.stem == word or _mentions(path, word)]
        known = {path: read_mapping(path) for path in files}
        by_name = [path for path, data in known.items() if word in (data.get("name"), path.stem)]
        by_tag = [path for path, data in known.items() if word in _tags(data)]
        if not by_name and not by_tag:
            tags = sorted({tag for data in known.values() for tag in _tags(data)})
            raise InputError(
                f"{word}: neither a file, nor a scenario of {folder or 'the suite'} "
                f"({', '.join(path.stem for path in known) or 'there is none'}), nor a tag "
                f"({', '.join(tags) or 'there is none'})"
                f"{did_you_mean(word, [*(path.stem for path in known), *tags])}"
            )
        found += by_name or by_tag
    return list(dict.fromkeys(found))


def one_scenario(word: str | Path, folder: Path | None = None) -> Path:
    """Return the file of one scenario; raise InputError for a tag of several scenarios."""
    found = scenarios_of([word], folder)
    if len(found) != 1:
        names = ", ".join(path.stem for path in found)
        raise InputError(f"{word}: stands for {len(found)} scenarios ({names}); name one of them")
    return found[0]


def settings_of(
    word: str | Path | None, overrides: Sequence[str] = (), seed: int | None = None
) -> Scenario:
    """Load a scenario, or the default settings for None; raise InputError if it is wrong."""
    # Settings import all packages that have some: not for a search by name or a listing.
    from experiments.scenario.loading import default_settings, load_scenario

    if word is None:
        return default_settings(overrides, seed)
    return load_scenario(one_scenario(word), overrides, seed)


def with_aligners(
    word: str | Path | None, overrides: Sequence[str], names: Sequence[str]
) -> list[str]:
    """Return the overrides with others that replace the aligners of a scenario.

    The first of the new aligners is used for the merge if the scenario's one is not among them.
    Bounds of metrics of other aligners are dropped.

    Args:
        word: scenario, as in `settings_of`.
        overrides: overrides of the scenario.
        names: aligners of the scenario, other methods, or classes in files; none keeps them all.

    Raises:
        InputError: a name is unknown, or the scenario is wrong.
    """
    if not names:
        return list(overrides)
    from experiments.scenario.settings import why_unknown

    scenario = settings_of(word, overrides)
    entries = chosen_aligners(names, scenario.align.aligners)
    chosen = [entry.name for entry in entries]
    own = {"align.aligners": [entry.model_dump(mode="json") for entry in entries]}
    if scenario.merge.aligner not in chosen:
        own |= {"merge.aligner": chosen[0]}
    own |= {
        "expect": {
            metric: bound.model_dump(mode="json")
            for metric, bound in scenario.expect.items()
            if not why_unknown(metric, chosen, scenario.fuse.fusers)
        }
    }
    return [*overrides, "align.also=[]", *(f"{key}={json.dumps(own[key])}" for key in own)]


def chosen_aligners(
    names: Sequence[str], entries: Sequence[AlignerEntry] = (), option: str = "--aligner"
) -> tuple[AlignerEntry, ...]:
    """Return aligners by name: of `entries`, else of the default list, else a method.

    A method has its default parameters. A class in a file, FILE.py:CLASS, is named CLASS. Raises
    InputError, which names the option, if a name is unknown.
    """
    from experiments.plugins.discovery import require_usable
    from experiments.scenario.settings import DEFAULT_ALIGNERS, AlignerEntry

    known, chosen = {entry.name: entry for entry in (*DEFAULT_ALIGNERS, *entries)}, []
    for name in dict.fromkeys(names):
        if name not in known:
            try:
                require_usable(name, {})
                known[name] = AlignerEntry(name=name.rpartition(":")[2], method=name)
            except ValueError as error:
                raise InputError(f"{option} {name}: {' '.join(str(error).split())}") from error
        chosen.append(known[name])
    return tuple(chosen)


def _mentions(path: Path, word: str) -> bool:
    try:
        return word.encode("utf-8", "surrogateescape") in path.read_bytes()
    except OSError:
        return True  # the reader reports the error


def scenario_names() -> list[str]:
    """Return the names of the suite's files without their suffix, sorted."""
    return [path.stem for path in _files(None)]


def tags_as_written() -> list[str]:
    """Return the tags of the suite that are written as `tags: [a, b]`, sorted.

    Files are searched and not read as YAML, which takes too long for a completion in the shell.
    """
    texts = (path.read_text(encoding="utf-8", errors="replace") for path in _files(None))
    lists = (_TAGS.findall(text) for text in texts)
    return sorted({tag.strip() for found in lists for each in found for tag in each.split(",")})


def _files(folder: Path | None) -> list[Path]:
    """Return the scenario files of a folder, sorted by name; those of the suite for None."""
    if folder is None:
        by_name = {path.stem: path for each in (SHIPPED, OWN) for path in _files(each)}
        return [by_name[name] for name in sorted(by_name)]
    return sorted(path for path in folder.glob("*") if path.suffix in {".yaml", ".yml"})


def _tags(data: dict) -> list[str]:
    tags = data.get("tags")
    return [str(tag) for tag in tags] if isinstance(tags, list) else []


def entries(folder: Path | None = None) -> list[dict[str, Any]]:
    """Return one row for each scenario of a folder or of the suite, sorted by name.

    `iterations` is the number of frames of a robot, None for recorded logs. `overlap` is the
    requested overlap of the robots' ground, None if the world is not generated. Settings are not
    checked: a value of an unexpected type is None.

    Raises:
        InputError: the folder has no scenario, or a file is not a mapping.
    """
    from sim.plan_generator import RouteParameters

    files = _files(folder)
    if not files:
        raise InputError(
            f"{folder}: holds no scenario (*.yaml); without a folder the suite is listed"
        )
    rows = []
    for path in files:
        data = read_mapping(path)
        sections = (data.get(name) for name in ("generate", "generated", "drive"))
        generate, generated, drive = (each if isinstance(each, dict) else {} for each in sections)
        robots, overlap = data.get("logs", data.get("robots")), generated.get("overlap_asked")
        n_robots = len(robots) if isinstance(robots, list) else None
        if "generate" in data:
            n_robots = generate.get("robots", RouteParameters.robots)
            overlap = generate.get("overlap", RouteParameters.overlap)
        rows.append(
            {
                "name": str(data.get("name", path.stem)),
                "tags": _tags(data),
                "description": str(data.get("description", "")),
                "recorded": "logs" in data,
                "robots": _number(n_robots),
                "iterations": _number(drive.get("frames")),
                "overlap": _number(overlap),
            }
        )
    return rows


def _number(value: Any) -> float | None:
    return value if isinstance(value, int | float) else None


MAX_SEEDS = 1000  # days of computation; more is probably a typing error


def parse_seeds(text: str) -> list[int]:
    """Parse `3`, `0..4` (both ends included) or `0,2,5`; raise InputError for other texts."""
    try:
        if ".." in text:
            first, last = (int(part) for part in text.split(".."))
            seeds = range(first, last + 1)[: MAX_SEEDS + 1]
        else:
            seeds = [int(part) for part in text.split(",")]
    except ValueError:
        seeds = []
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise InputError(f"--seeds {text}: expected a number, a range 0..4 or a list 0,2,5")
    if len(seeds) > MAX_SEEDS:
        raise InputError(f"--seeds {text}: more than {MAX_SEEDS} seeds")
    return list(seeds)


# Settings that users change first.
COMMON_SETTINGS = (
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
    from experiments.scenario.loading import schema_text  # slow imports
    from mapfusion.files import write_atomically

    shipped = {path.stem: path for path in _files(SHIPPED)}
    if name not in shipped:
        raise InputError(f"--copy {name}: no scenario of the suite; known: {', '.join(shipped)}")
    source = shipped[name]
    copy, schema = OWN / source.name, OWN / "schema.json"
    if copy.exists():
        raise InputError(f"{copy}: exists; edit it, or rename it to get the shipped one again")
    for path, text in ((schema, schema_text()), (copy, with_common_settings(source))):
        write_atomically(path, lambda file, text=text: file.write_text(text, encoding="utf-8"))
    return copy, schema


def with_common_settings(path: Path) -> str:
    """Return the text of a scenario file, with common settings that it lacks as comments.

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
    from experiments.scenario.loading import load_scenario, schema_text
    from experiments.scenario.settings import Recording

    scenario, schema = load_scenario(path), json.loads(schema_text())
    present = scenario.resolved()
    kind = "Simulation"
    if isinstance(scenario, Recording):
        kind = "Recording"
    elif scenario.generated is not None:
        kind = "GeneratedScenario"
    for dotted in COMMON_SETTINGS:
        key = tuple(dotted.split("."))
        field: dict[str, Any] | None = {"$ref": f"#/$defs/{kind}"}
        value: Any = present
        for part in key:
            if field and "$ref" in field:
                field = schema["$defs"][field["$ref"].rpartition("/")[2]]
            field = field.get("properties", {}).get(part) if field else None
            value = value.get(part) if isinstance(value, dict) else None
        if field is not None:
            about = field.get("description", "").partition(". ")[0].partition(";")[0]
            yield key, field.get("default") if value is None else value, about.rstrip(".")
