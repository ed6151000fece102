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

SHIPPED = Path(__file__).with_name("shipped")  # the repository's scenarios/, also where installed
OWN = Path("scenarios")  # what shipped files name lies beside it, as it does in the repository
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
        folder = OWN if path.parent == SHIPPED else path.parent
        logs = [str((folder / log).resolve()) for log in scenario.logs]
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
    """One section of a scenario, or its defaults, with overrides inside it; raises InputError."""
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
    # A wrong name explains the missing one that follows from it, so it goes first.
    problems = error.errors(include_url=False)
    problem, *more = sorted(problems, key=lambda each: each["type"] not in _UNKNOWN)
    location = problem["loc"]
    message = problem["msg"].removeprefix("Value error, ")
    if problem["type"] in _UNKNOWN:
        message = _about_unknown(location, list(_keys(schema, schema)))
    elif problem["type"] != "value_error" and not isinstance(problem["input"], dict):
        message = f"{message} (it is {problem['input']!r})"
    where = f"{'.'.join(map(str, location))}: " if location else ""
    return f"{where}{message}" + (f" (and {len(more)} more)" if more else "")


def _about_unknown(location: tuple[int | str, ...], known: list[tuple[str, ...]]) -> str:
    """The names that would have been right there, and keys of which the wrong one is a word."""
    *above, name = location
    beside = [path for path in known if len(path) == len(location)]
    for i, part in enumerate(above):
        beside = [path for path in beside if path[i] in {"*", part}]
    like = [".".join(path) for path in known if name in path[-1].split("_") and "*" not in path]
    message = f"unknown key; known here: {', '.join(sorted(path[-1] for path in beside))}"
    return message + (f"; did you mean {' or '.join(like[:_MOST_SUGGESTED])}?" if like else "")


def _keys(root: dict[str, Any], node: dict[str, Any], *above: str) -> Iterator[tuple[str, ...]]:
    """All keys below a node; `*` stands for places in lists and for free keys, as in `expect`."""
    node = next((option for option in node.get("anyOf", []) if "$ref" in option), node)
    if "$ref" in node:
        node = root["$defs"][node["$ref"].rsplit("/", 1)[1]]
    for key, child in node.get("properties", {}).items():
        yield (*above, key)
        yield from _keys(root, child, *above, key)
    for children in (node.get("items"), node.get("additionalProperties")):
        if isinstance(children, dict):
            yield from _keys(root, children, *above, "*")
