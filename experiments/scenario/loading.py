"""Load a scenario file into a validated scenario, or report each wrong field in one line."""

import functools
import inspect
import json
import re
import reprlib
import warnings
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import to_jsonable_python

from experiments.plugins.discovery import absolute_method, name_clashes
from experiments.scenario.settings import (
    Align,
    AnyScenario,
    ContradictingSections,
    GeneratedScenario,
    Recording,
    Scenario,
    SimulatedScenario,
    Simulation,
    broken_rules,
    merged_by_what_is_aligned,
    sections_of,
)
from experiments.scenario.world_settings import expanded
from experiments.scenario.yaml_files import (
    OWN,
    SHIPPED,
    apply_overrides,
    lines_of_keys,
    read_mapping,
)
from mapfusion.errors import (
    InputError,
    InputErrors,
    NameClashWarning,
    OutOfRangeError,
    did_you_mean,
)
from mapfusion.parameters import Range

S = TypeVar("S")
Location = tuple[int | str, ...]  # keys and list indices, from the root of a scenario
Place = Callable[[Location], str]  # the line or override of the value at a location
_MOST_LINES = 20  # error lines of one scenario
_MOST_SUGGESTED = 3  # keys that an error message suggests
_UNKNOWN = {"extra_forbidden", "unexpected_keyword_argument"}
# Settings of earlier versions, with the settings that replace them.
_RETIRED = {
    "slam.filter.noise_scale": "errors that are alike from frame to frame are "
    "slam.filter.stray_m, those of single observations vision.sigma_uv_px",
    "merge.parameters.use_drift": "every run has both fusers, kalman and kalman-drift",
}
_WORLD = {"world", "robots", "drive"}  # required in a simulation, forbidden in a recording
_LONG_NAME = 64 * "x"  # longer than the name of any file of a log
_EITHER = "give either world, robots and drive, or logs; generate stands for world and robots"
_FIELDS = GeneratedScenario.model_fields | Simulation.model_fields | Recording.model_fields
# Resolved recordings of earlier versions also have the sections of simulations, without effect.
_OF_ONE_KIND = _FIELDS.keys() - Scenario.model_fields.keys()
_SIMULATION_S_OWN = {
    name: to_jsonable_python(field.default)
    for name, field in SimulatedScenario.model_fields.items()
    if name in _OF_ONE_KIND and not field.is_required()
}


def _nowhere(_: Location) -> str:
    return ""


def load_scenario(
    path: Path,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    content: dict[str, Any] | None = None,
) -> AnyScenario:
    """Read and validate a scenario.

    Args:
        path: the file.
        overrides: entries `key.sub=value` that replace values of the file.
        seed: replaces the seed of the file; None keeps it.
        content: content of the file if it has been read before; None reads it.

    Raises:
        InputError: the scenario is wrong. Each problem has one line with the file, its line, the
            key and the allowed values.
    """
    _require_whole_paths(overrides)
    folder = OWN if path.parent == SHIPPED else path.parent
    written = read_mapping(path) if content is None else content
    data = apply_overrides(_with_absolute_methods(written, folder), overrides)
    if seed is not None:
        data["seed"] = seed

    def place(location: Location) -> str:
        """Return the line of the file or the override that gives the value at a location."""
        for override in reversed(overrides):
            own = override.partition("=")[0].split(".")
            beginning = [str(part) for part in location[: len(own)]]
            if beginning and own[: len(beginning)] == beginning:
                return f", --set {override}"
        above = (location[:n] for n in range(len(location), 0, -1))
        line = next((_lines(path)[each] for each in above if each in _lines(path)), None)
        return "" if line is None else f", line {line}"

    scenario = scenario_of(data, str(path), place)
    _warn_of_name_clashes(scenario.align)
    if not isinstance(scenario, Recording):
        return scenario
    logs = []
    for log in scenario.logs:
        try:
            resolved = (folder / log).resolve()
            (resolved / _LONG_NAME).exists()  # raises if the path is too long for the system
        except (OSError, RuntimeError, ValueError) as error:  # circular links, a long name
            reason = error.strerror if isinstance(error, OSError) else error
            raise InputError(f"{path}: logs: {log}: no folder has this path ({reason})") from error
        logs.append(str(resolved))
    return scenario.model_copy(update={"logs": logs})


def _with_absolute_methods(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the content of a file in `folder` with absolute paths of aligners in Python files."""
    align = data.get("align")
    if not isinstance(align, dict):
        return data
    lists = {
        name: align[name] for name in ("aligners", "also") if isinstance(align.get(name), list)
    }
    resolved = {
        name: [
            each | {"method": absolute_method(each["method"], folder)}
            if isinstance(each, dict) and isinstance(each.get("method"), str)
            else each
            for each in entries
        ]
        for name, entries in lists.items()
    }
    return data | {"align": align | resolved}


# Each wrong key of a file needs the lines.
_lines = functools.lru_cache(maxsize=1)(lines_of_keys)


def scenario_of(data: dict[str, Any], where: str, place: Place = _nowhere) -> AnyScenario:
    """Validate the content of a scenario file.

    Args:
        data: the content.
        where: the file, with which error messages begin.
        place: returns the line of the value at a location.

    Returns:
        a simulation or a recording; a generated world is drawn.

    Raises:
        InputError: the scenario is wrong.
    """
    data = {k: v for k, v in data.items() if k not in _OF_ONE_KIND or v not in (None, [])}
    drawn, recorded = "generate" in data, "logs" in data
    if recorded:
        own = _SIMULATION_S_OWN.items()
        data = {k: v for k, v in data.items() if (k, v) not in own}
    if drawn and (others := data.keys() & {"world", "robots", "logs"}):
        _require_not_added(where, place, {"generate"}, others)
        raise InputError(f"{where}: give either generate, or world and robots, or logs")
    needed = {"drive"} if drawn else _WORLD
    unclear = bool(data.keys() & _WORLD) if recorded else not data.keys() >= needed
    if unclear and data.keys() <= _FIELDS.keys():  # otherwise report the unknown name
        if recorded:
            _require_not_added(where, place, {"logs"}, data.keys() & _WORLD)
        raise InputError(f"{where}: {_EITHER}")
    if drawn:
        asked = _validated(where, GeneratedScenario, data, place)
        try:
            made = expanded(asked.generate, asked.seed)
        except InputError as error:
            raise InputError(f"{where}: generate.{error}") from error
        made["render"] = asked.render.model_dump()
        data = {key: value for key, value in data.items() if key != "generate"} | made
    return _validated(where, Recording if recorded else Simulation, data, place)


def _require_not_added(where: str, place: Place, *kinds: Set[str]) -> None:
    """Raise InputError for an override that adds a section to a scenario of another kind.

    Args:
        where: the file, with which the message begins.
        place: returns the override that gives the value at a location.
        kinds: the sections that exclude each other, in two sets.
    """
    for own, others in (kinds, kinds[::-1]):
        for name in sorted(own):
            if (by := place((name,))).startswith(", --set"):
                has = f"this scenario has {' and '.join(sorted(others))}, and no {name}"
                raise InputError(f"{where}{by}: {has}; leave it out ({_EITHER})")


def made_settings(
    where: str, kind: type[S], overrides: Sequence[str], base: dict[str, Any] | None = None
) -> S:
    """Return settings of a class: defaults or `base`, with overrides.

    Raises:
        InputError: a value is wrong; the message begins with `where`.
    """
    made = _validated(where, kind, apply_overrides(base or {}, overrides))
    if not is_dataclass(kind):
        return made
    # an instance of the class itself can be pickled, one of pydantic's subclass cannot
    return kind(**{own.name: getattr(made, own.name) for own in fields(kind)})


class _StepSettings(Scenario):
    """Settings of a single step on files, without the rule about the merge."""

    RULES = tuple(rule for rule in Scenario.RULES if rule is not merged_by_what_is_aligned)


def default_settings(overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """Return the default settings of a scenario without its world, with overrides.

    Raises:
        InputError: a value is wrong; the message names the key and the allowed values.
    """
    _require_whole_paths(overrides)
    data = apply_overrides({"schema_version": 1, "name": "defaults"}, overrides)
    settings = _validated("--set", _StepSettings, data if seed is None else data | {"seed": seed})
    _warn_of_name_clashes(settings.align)
    return settings


def _require_whole_paths(overrides: Sequence[str]) -> None:
    """Refuse a key without its first sections, such as `filter.n_particles`."""
    roots = _FIELDS.keys() | GeneratedScenario.model_fields.keys()
    for key in (override.partition("=")[0] for override in overrides):
        first, *rest = key.split(".")
        if first and first not in roots:
            known = _known_keys(Simulation)
            ends = [path for path in known if path[-1] == first and "*" not in path]
            meant = sorted(((*path, *rest) for path in ends), key=lambda path: path not in known)
            if meant:
                whole = f"keys begin at the scenario's root: {'.'.join(meant[0])}"
                raise InputError(f"--set {key}: {whole}")


def _warn_of_name_clashes(align: Align) -> None:
    for method in dict.fromkeys(entry.method for entry in align.aligners):
        if method in name_clashes():
            warnings.warn(name_clashes()[method], NameClashWarning, stacklevel=3)


@functools.cache  # a sweep validates the same classes many times
def _known(kind: type[S]) -> TypeAdapter[S]:
    strict = kind
    if is_dataclass(kind):  # settings of an importer; sections forbid unknown keys themselves
        strict = dataclass(kind, config=ConfigDict(extra="forbid"), frozen=True)
    return TypeAdapter(strict)


@functools.cache
def _known_keys(kind: type) -> list[tuple[str, ...]]:
    schema = _schema(kind)
    return list(_keys(schema, schema))


def setting_keys() -> list[str]:
    """Return the dotted keys of all settings that have a value of their own, sorted."""
    known = {*_known_keys(Simulation), *_known_keys(GeneratedScenario)}
    sections = {path[:-1] for path in known}
    return sorted(".".join(path) for path in known - sections if "*" not in path)


@functools.cache
def _schema(kind: type[S]) -> dict[str, Any]:
    return _known(kind).json_schema()


class Problem(NamedTuple):
    """Reason why the value at a location is refused."""

    location: Location
    text: str


def _validated(where: str, kind: type[S], data: dict[str, Any], place: Place = _nowhere) -> S:
    """Validate a section of a class; raise InputErrors with one line for each problem."""
    schema = _schema(kind)
    problems = list(_unfit(schema, schema, data, ()))
    unfit = {problem.location for problem in problems}
    try:
        made: Any = _known(kind).validate_python(data)
        if not problems:
            return made
    except ValidationError as error:
        refused = []
        for problem in _refused(kind, error):
            at, last = problem.location, len(problem.location)
            if not any(at[:n] in unfit for n in range(last + 1)):  # not at or below an unfit value
                refused.append(problem)
        problems = refused + problems
    if isinstance(kind, type) and issubclass(kind, Scenario):
        # contradictions between sections that are valid by themselves
        wrong, sections = {problem.location[:1] for problem in problems}, dict[str, Any]()
        for name in sections_of(kind.RULES) & kind.model_fields.keys():
            field = kind.model_fields[name]
            if (name,) in wrong or (field.is_required() and name not in data):
                continue
            own: Any = field.annotation
            sections[name] = (
                _known(own).validate_python(data[name])
                if name in data
                else field.get_default(call_default_factory=True)
            )
        problems += map(_problem_of_line, broken_rules(kind.RULES, sections))
    lines = []
    for location, text in dict.fromkeys(problems):
        named = f"{'.'.join(map(str, location))}: " if location else ""
        lines.append(f"{where}{place(location)}: {named}{text}")
    if len(lines) > _MOST_LINES:
        lines[_MOST_LINES:] = [f"{where}: {len(lines) - _MOST_LINES} more things are wrong"]
    raise InputErrors(lines)


# Ends of messages about missing keys that every scenario needs.
_EXAMPLES: dict[Location, str] = {
    ("schema_version",): "; write schema_version: 1",
    ("name",): "; write a name of your choice, for example name: mine",
}


def _refused(kind: type, error: ValidationError) -> Iterator[Problem]:
    """Yield the problems of a failed validation."""
    # An unknown name comes first: it often explains a missing one.
    for each in sorted(
        error.errors(include_url=False), key=lambda problem: problem["type"] not in _UNKNOWN
    ):
        location, text = each["loc"], each["msg"].removeprefix("Value error, ")
        cause = each.get("ctx", {}).get("error")
        if isinstance(cause, OutOfRangeError):
            for name, problem in ((cause.name, cause.problem), *cause.also):
                yield Problem((*location, *_parts(name)), problem)
        elif isinstance(cause, ContradictingSections):
            yield from map(_problem_of_line, cause.problems)
        elif each["type"] == "missing":
            yield Problem(location, f"is missing{_EXAMPLES.get(location, '')}")
        elif each["type"] == "string_pattern_mismatch":
            allowed = "expected letters, digits, - and _, first a letter or digit, 41 at most"
            yield Problem(location, f"is {reprlib.repr(each['input'])}, {allowed}")
        elif each["type"] in _UNKNOWN:
            yield Problem(location, _about_unknown(location, _known_keys(kind)))
        elif each["type"] != "value_error" and not isinstance(each["input"], dict):
            yield Problem(location, f"{text} (it is {reprlib.repr(each['input'])})")
        else:
            yield Problem(location, text)


def _problem_of_line(line: str) -> Problem:
    """Split a line of a rule into the key at its beginning and the text."""
    name, _, text = line.partition(": ")
    section, _, metric = name.partition(".")
    return Problem((section, metric) if section == "expect" else _parts(name), text)


def _parts(name: str) -> Location:
    return tuple(int(part) if part.isdecimal() else part for part in name.split("."))


# Types of values in the terms of JSON schemas.
_TYPES: dict[type, str] = {
    type(None): "null",
    bool: "boolean",
    int: "integer",
    float: "number",
    str: "string",
    list: "array",
    dict: "object",
}
_KINDS = {
    "boolean": "true or false",
    "integer": "an integer",
    "number": "a number",
    "string": "a text",
    "array": "a list",
    "object": "a mapping",
}


def _unfit(
    root: dict[str, Any], node: dict[str, Any], value: Any, location: Location
) -> Iterator[Problem]:
    """Yield values below a node that do not match the types and ranges of the JSON schema `root`.

    As in any JSON schema, an integer may be written 5.0. Texts and truth values are not numbers.
    """
    options = list(_options(root, node))
    allowed = {option["type"] for option in options if "type" in option}
    if not allowed or not all("type" in option for option in options):
        return
    is_whole = isinstance(value, float) and value.is_integer()
    kind = "integer" if is_whole else _TYPES[type(value)]
    if kind not in allowed | ({"integer"} if "number" in allowed else set()):
        wanted = " or ".join(_KINDS[each] for each in _KINDS if each in allowed)
        shown = json.dumps(value) if isinstance(value, bool | None) else reprlib.repr(value)
        yield Problem(location, f"is {shown}, expected {wanted}")
        return
    for option in options:
        if "unit" in option and isinstance(value, int | float):
            bounds = Range(option["minimum"], option["maximum"], option["unit"])
            if problem := bounds.problem(value):
                yield Problem(location, problem)
        if isinstance(value, dict) and option["type"] == "object":
            others = option.get("additionalProperties")
            for key, below in value.items():
                own = option.get("properties", {}).get(key, others)
                if isinstance(own, dict):
                    yield from _unfit(root, own, below, (*location, key))
        elif isinstance(value, list) and option["type"] == "array":
            each = option.get("prefixItems", [option.get("items", {})] * len(value))
            for i, (own, below) in enumerate(zip(each, value, strict=False)):
                yield from _unfit(root, own, below, (*location, i))


def _options(root: dict[str, Any], node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the alternatives of a node of a JSON schema."""
    if "$ref" in node:
        yield from _options(root, root["$defs"][node["$ref"].rsplit("/", 1)[1]])
    elif "anyOf" in node:
        for option in node["anyOf"]:
            yield from _options(root, option)
    else:
        yield node


def _about_unknown(location: tuple[int | str, ...], known: list[tuple[str, ...]]) -> str:
    """Return a message with the known names and the most similar ones."""
    if replacement := _RETIRED.get(".".join(map(str, location))):
        return f"retired; {replacement}"
    *above, wrong = location
    beside = [path for path in known if len(path) == len(location)]
    for i, part in enumerate(above):
        beside = [path for path in beside if path[i] in {"*", part}]
    here = sorted({path[-1] for path in beside})
    message = f"unknown key; known here: {', '.join(here)}"
    meant = did_you_mean(str(wrong), here)
    # otherwise suggest keys of other sections that contain the word
    like = [".".join(p) for p in known if wrong in p[-1].split("_") and "*" not in p]
    if like and not meant:
        meant = f"; did you mean {' or '.join(like[:_MOST_SUGGESTED])}?"
    return message + meant


def _keys(root: dict[str, Any], node: dict[str, Any], *above: str) -> Iterator[tuple[str, ...]]:
    """Yield all keys below a node; `*` stands for list indices and free keys, as in `expect`."""
    node = next((option for option in node.get("anyOf", []) if "$ref" in option), node)
    if "$ref" in node:
        node = root["$defs"][node["$ref"].rsplit("/", 1)[1]]
    for key, child in node.get("properties", {}).items():
        yield (*above, key)
        yield from _keys(root, child, *above, key)
    for children in (node.get("items"), node.get("additionalProperties")):
        if isinstance(children, dict):
            yield from _keys(root, children, *above, "*")


# "name, other: text", with further lines indented
_ENTRY = re.compile(r"^    (\w+(?:, \w+)*): (.+(?:\n {5,}.+)*)", re.MULTILINE)


class _Described(GenerateJsonSchema):
    """Schema generator that adds to each field its docstring entry and its unit."""

    def model_schema(self, schema: Any) -> dict[str, Any]:
        return _described(super().model_schema(schema), schema["cls"])

    def dataclass_schema(self, schema: Any) -> dict[str, Any]:
        return _described(super().dataclass_schema(schema), schema["cls"])


def schema_text() -> str:
    """Return the schema as JSON text with a final line break."""
    kinds = TypeAdapter[object](Simulation | GeneratedScenario | Recording)
    schema = kinds.json_schema(schema_generator=_Described)
    return json.dumps(schema, indent=1) + "\n"


def _described(schema: dict[str, Any], owner: type) -> dict[str, Any]:
    described = attributes_of(owner)
    schema["description"] = schema["description"].partition("\n\nAttributes:")[0]
    for name, field in schema["properties"].items():
        units = dict.fromkeys(_units(field))
        unit = f" [{', '.join(units)}]" if units else ""
        field["description"] = described[name] + unit
        field.pop("title", None)  # pydantic repeats the name
    return schema


def attributes_of(owner: type) -> dict[str, str]:
    """Return the docstring entry of each attribute of a class and its bases, as one line."""
    found: dict[str, str] = {}
    for kind in reversed(owner.__mro__):
        text = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")[2]
        for names, about in _ENTRY.findall(text):
            found |= dict.fromkeys(names.split(", "), " ".join(about.split()))
    return found


def _units(node: Any) -> list[str]:
    """Remove the units from the schema of a field and return them."""
    if isinstance(node, list):
        return [unit for each in node for unit in _units(each)]
    if not isinstance(node, dict):
        return []
    own = [node.pop("unit")] if "unit" in node else []
    return own + [unit for each in node.values() for unit in _units(each)]
