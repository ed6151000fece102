"""Scenario files in, validated scenarios out, or one line: the field, and what would be right."""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_jsonable_python

from experiments.methods.catalogue import name_clashes
from experiments.scenario.generated import Generate, expanded
from experiments.scenario.settings import (
    Align,
    AnyScenario,
    GeneratedScenario,
    Recording,
    Scenario,
    Simulation,
)
from experiments.scenario.yaml_input import apply_overrides, read_mapping
from mapfusion.errors import InputError, NameClashWarning

S = TypeVar("S")
_MOST_SUGGESTED = 3  # keys that an error message offers
_UNKNOWN = {"extra_forbidden", "unexpected_keyword_argument"}
_WORLD = {"world", "robots", "drive"}  # what a simulation must have and a recording cannot
_EITHER = "give either world, robots and drive, or logs; generate stands for world and robots"
_FIELDS = Simulation.model_fields | Recording.model_fields
# What says nothing: resolved scenarios of earlier versions name all sections.
_SILENT = {"generate": [None]} | {
    name: [None, [], *([] if field.is_required() else [to_jsonable_python(field.default)])]
    for name, field in _FIELDS.items()
    if name not in Scenario.model_fields
}


def load_scenario(
    path: Path, overrides: Sequence[str] = (), seed: int | None = None
) -> AnyScenario:
    """Read and validate a scenario, with entries `key.sub=value` and the seed replaced.

    Raises:
        InputError: one line that names the file, the field and what would be right.
    """
    data = apply_overrides(read_mapping(path), overrides)
    if seed is not None:
        data["seed"] = seed
    scenario = scenario_of(data, str(path))
    _warn_of_name_clashes(scenario.align)
    if isinstance(scenario, Recording):
        logs = [str((path.parent / log).resolve()) for log in scenario.logs]
        return scenario.model_copy(update={"logs": logs})
    return scenario


def scenario_of(data: dict[str, Any], where: str) -> AnyScenario:
    """The simulation or the recording that the content of a file describes.

    Raises:
        InputError: one line that begins with `where`.
    """
    data = _expanded(where, data)
    data = {key: value for key, value in data.items() if value not in _SILENT.get(key, [])}
    if "generate" in data:  # nothing can be drawn from this seed
        _validated(where, GeneratedScenario, data)
    recorded = "logs" in data
    unclear = bool(data.keys() & _WORLD) if recorded else not data.keys() >= _WORLD
    if unclear and data.keys() <= _FIELDS.keys():  # a misspelt name is the better explanation
        raise InputError(f"{where}: {_EITHER}")
    return _validated(where, Recording if recorded else Simulation, data)


def _expanded(where: str, data: dict[str, Any]) -> dict[str, Any]:
    """The data with the world and the robots that its `generate` section stands for."""
    if data.get("generate") is None:
        return data
    if data.get("world") is not None or data.get("robots") or data.get("logs"):
        raise InputError(f"{where}: give either generate, or world and robots, or logs")
    # the rest is judged first: what is wrong with the seed must not show as a broken plan
    if not isinstance(data.get("seed", 0), int):
        return data
    settings = _validated(f"{where}: generate", Generate, data["generate"])
    try:
        made = expanded(settings, data.get("seed", 0))
    except InputError as error:
        raise InputError(f"{where}: generate.{error}") from error
    return {key: value for key, value in data.items() if key != "generate"} | made


def load_section(path: Path | None, name: str, kind: type[S], overrides: Sequence[str]) -> S:
    """One section of a scenario (or its defaults, without a file), with overrides inside it.

    Raises:
        InputError: as `load_scenario`.
    """
    where, data = name, {}
    if path is not None:
        load_scenario(path)
        where, data = f"{path}: {name}", read_mapping(path).get(name) or {}
    section = _validated(where, kind, apply_overrides(data, overrides))
    if path is None and isinstance(section, Align):
        _warn_of_name_clashes(section)
    return section


def _warn_of_name_clashes(align: Align) -> None:
    for method in dict.fromkeys(entry.method for entry in align.aligners):
        if method in name_clashes():
            warnings.warn(name_clashes()[method], NameClashWarning, stacklevel=3)


def _validated(where: str, kind: type[S], data: dict[str, Any]) -> S:
    known = TypeAdapter(kind)
    try:
        return known.validate_python(data)
    except ValidationError as error:
        raise InputError(f"{where}: {_first_problem(known.json_schema(), error)}") from error


def _first_problem(schema: dict[str, Any], error: ValidationError) -> str:
    """The first thing wrong with a section of that JSON schema, and how many more there are."""
    problems = error.errors(include_url=False)
    # A wrong name explains the missing one that follows from it, so it goes first.
    unknown = [problem for problem in problems if problem["type"] in _UNKNOWN]
    problem = (unknown or problems)[0]
    location = problem["loc"]
    message = problem["msg"].removeprefix("Value error, ")
    if unknown:
        message = f"unknown key; known here: {', '.join(_siblings(schema, location))}"
        elsewhere = list(_paths_like(schema, schema, str(location[-1])))[:_MOST_SUGGESTED]
        message += f"; did you mean {' or '.join(elsewhere)}?" if elsewhere else ""
    elif problem["type"] != "value_error" and not isinstance(problem["input"], dict):
        message = f"{message} (it is {problem['input']!r})"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    where = f"{'.'.join(map(str, location))}: " if location else ""
    return f"{where}{message}{more}"


def _siblings(root: dict[str, Any], location: Sequence[int | str]) -> list[str]:
    """The names that would have been right beside an unknown one."""
    node = root
    for part in location[:-1]:
        node = _resolved(root, node)
        if isinstance(part, int):
            node = node["items"]
        else:  # a mapping with free keys, as `expect`, describes all its values at once
            node = node.get("properties", {}).get(part) or node["additionalProperties"]
    return sorted(_resolved(root, node)["properties"])


def _paths_like(root: dict[str, Any], node: dict[str, Any], name: str) -> Iterator[str]:
    """Dotted keys below a node whose last part holds this name as a word: n_particles."""
    for key, child in _resolved(root, node).get("properties", {}).items():
        if name in key.split("_"):
            yield key
        yield from (f"{key}.{path}" for path in _paths_like(root, child, name))


def _resolved(root: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    node = next((option for option in node.get("anyOf", []) if "$ref" in option), node)
    reference = node.get("$ref")
    return root["$defs"][reference.rsplit("/", 1)[1]] if reference else node
