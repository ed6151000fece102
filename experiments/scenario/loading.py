"""Scenario files in, validated scenarios out, or one line: the field, and what would be right."""

import functools
import reprlib
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass
from pydantic_core import to_jsonable_python

from experiments.methods.catalogue import name_clashes
from experiments.scenario.generated import expanded
from experiments.scenario.settings import (
    Align,
    AnyScenario,
    GeneratedScenario,
    Recording,
    Scenario,
    SimulatedScenario,
    Simulation,
)
from experiments.scenario.yaml_input import apply_overrides, read_mapping
from mapfusion.errors import InputError, NameClashWarning, OutOfRangeError, did_you_mean

SHIPPED = Path(__file__).with_name("shipped")  # the repository's scenarios/, also where installed
OWN = Path("scenarios")  # what shipped files name lies beside it, as it does in the repository
S = TypeVar("S")
_MOST_SUGGESTED = 3  # keys that an error message offers
_UNKNOWN = {"extra_forbidden", "unexpected_keyword_argument"}
# Settings that were, and what says the same now.
_RETIRED = {
    "slam.filter.noise_scale": "errors that are alike from frame to frame are "
    "slam.filter.stray_m, those of single observations vision.sigma_uv_px",
    "merge.parameters.use_drift": "every run has both fusers, kalman and kalman-drift",
}
_WORLD = {"world", "robots", "drive"}  # what a simulation must have and a recording cannot
_LONG_NAME = 64 * "x"  # longer than that of any file of a log
_EITHER = "give either world, robots and drive, or logs; generate stands for world and robots"
_FIELDS = GeneratedScenario.model_fields | Simulation.model_fields | Recording.model_fields
# Resolved recordings of earlier versions name all sections, also a simulation's, which say nothing.
_OF_ONE_KIND = _FIELDS.keys() - Scenario.model_fields.keys()
_SIMULATION_S_OWN = {
    name: to_jsonable_python(field.default)
    for name, field in SimulatedScenario.model_fields.items()
    if name in _OF_ONE_KIND and not field.is_required()
}


def load_scenario(
    path: Path,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    content: dict[str, Any] | None = None,
) -> AnyScenario:
    """Read and validate a scenario, with entries `key.sub=value` and the seed replaced.

    Args:
        path: of the file.
        overrides: the entries.
        seed: in place of the file's; None for that.
        content: of the file, where it was read before; None to read it.

    Raises:
        InputError: one line that names the file, the field and what would be right.
    """
    _require_whole_paths(overrides)
    data = apply_overrides(read_mapping(path) if content is None else content, overrides)
    if seed is not None:
        data["seed"] = seed
    scenario = scenario_of(data, str(path))
    _warn_of_name_clashes(scenario.align)
    if isinstance(scenario, Recording):
        folder = OWN if path.parent == SHIPPED else path.parent
        logs = [_resolved(path, folder, log) for log in scenario.logs]
        return scenario.model_copy(update={"logs": logs})
    return scenario


def _resolved(path: Path, folder: Path, log: str) -> str:
    try:
        resolved = (folder / log).resolve()
        (resolved / _LONG_NAME).exists()  # raises where a path is too long for the system
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a name too long
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: logs: {log}: no folder has this path ({reason})") from error
    return str(resolved)


def scenario_of(data: dict[str, Any], where: str) -> AnyScenario:
    """The simulation or the recording that the content of a file describes.

    Raises:
        InputError: one line that begins with `where`.
    """
    data = {k: v for k, v in data.items() if k not in _OF_ONE_KIND or v not in (None, [])}
    drawn, recorded = "generate" in data, "logs" in data
    if recorded:
        own = _SIMULATION_S_OWN.items()
        data = {k: v for k, v in data.items() if (k, v) not in own}
    if drawn and data.keys() & {"world", "robots", "logs"}:
        raise InputError(f"{where}: give either generate, or world and robots, or logs")
    needed = {"drive"} if drawn else _WORLD
    unclear = bool(data.keys() & _WORLD) if recorded else not data.keys() >= needed
    if unclear and data.keys() <= _FIELDS.keys():  # a misspelt name is the better explanation
        raise InputError(f"{where}: {_EITHER}")
    if drawn:
        asked = _validated(where, GeneratedScenario, data)
        try:
            made = expanded(asked.generate, asked.seed)
        except InputError as error:
            raise InputError(f"{where}: generate.{error}") from error
        made["render"] = asked.render.model_dump()
        data = {key: value for key, value in data.items() if key != "generate"} | made
    return _validated(where, Recording if recorded else Simulation, data)


def made_settings(
    where: str, kind: type[S], overrides: Sequence[str], base: dict[str, Any] | None = None
) -> S:
    """Settings of that kind alone: defaults, or what `base` says, with overrides.

    Raises:
        InputError: one line that begins with `where`.
    """
    made = _validated(where, kind, apply_overrides(base or {}, overrides))
    if not is_dataclass(kind):
        return made
    # of the class itself, which can be sent to another process; pydantic's own one cannot
    return kind(**{own.name: getattr(made, own.name) for own in fields(kind)})


class _StepSettings(Scenario):
    """Settings of one step on files: aligning alone need not be able to merge."""

    @model_validator(mode="after")
    def _merges_what_it_aligns(self) -> Self:
        return self


def default_settings(overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """What a scenario sets beside its world, for work on files: defaults, with overrides.

    Raises:
        InputError: one line that names the key and what would be right.
    """
    _require_whole_paths(overrides)
    data = apply_overrides({"schema_version": 1, "name": "defaults"}, overrides)
    settings = _validated("--set", _StepSettings, data if seed is None else data | {"seed": seed})
    _warn_of_name_clashes(settings.align)
    return settings


def _require_whole_paths(overrides: Sequence[str]) -> None:
    """Refuse a key that lacks its beginning, as `filter.n_particles` does."""
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


@functools.cache  # a sweep and a campaign validate the same few kinds again and again
def _known(kind: type[S]) -> TypeAdapter[S]:
    strict = kind
    if is_dataclass(kind):  # an importer's settings; sections say themselves what they forbid
        strict = dataclass(kind, config=ConfigDict(extra="forbid"), frozen=True)
    return TypeAdapter(strict)


@functools.cache
def _known_keys(kind: type) -> list[tuple[str, ...]]:
    schema = _known(kind).json_schema()
    return list(_keys(schema, schema))


def _validated(where: str, kind: type[S], data: dict[str, Any]) -> S:
    try:
        return _known(kind).validate_python(data)
    except ValidationError as error:
        raise InputError(f"{where}: {_first_problem(kind, error)}") from error


def _first_problem(kind: type, error: ValidationError) -> str:
    """The first thing wrong with a section of that kind, and how many more there are."""
    # A wrong name explains the missing one that follows from it, so it goes first.
    problems = error.errors(include_url=False)
    problem, *more = sorted(problems, key=lambda each: each["type"] not in _UNKNOWN)
    location = problem["loc"]
    message = problem["msg"].removeprefix("Value error, ")
    cause = problem.get("ctx", {}).get("error")
    if isinstance(cause, OutOfRangeError):
        location, message = (*location, cause.name), cause.problem
    elif problem["type"] in _UNKNOWN:
        message = _about_unknown(location, _known_keys(kind))
    elif problem["type"] != "value_error" and not isinstance(problem["input"], dict):
        message = f"{message} (it is {reprlib.repr(problem['input'])})"
    where = f"{'.'.join(map(str, location))}: " if location else ""
    return f"{where}{message}" + (f" (and {len(more)} more)" if more else "")


def _about_unknown(location: tuple[int | str, ...], known: list[tuple[str, ...]]) -> str:
    """The names that would have been right there, and those that may have been meant."""
    if told := _RETIRED.get(".".join(map(str, location))):
        return f"retired; {told}"
    *above, wrong = location
    beside = [path for path in known if len(path) == len(location)]
    for i, part in enumerate(above):
        beside = [path for path in beside if path[i] in {"*", part}]
    here = sorted({path[-1] for path in beside})
    message = f"unknown key; known here: {', '.join(here)}"
    meant = did_you_mean(str(wrong), here)
    # else a key of another section, of which the wrong one is a word
    like = [".".join(p) for p in known if wrong in p[-1].split("_") and "*" not in p]
    if like and not meant:
        meant = f"; did you mean {' or '.join(like[:_MOST_SUGGESTED])}?"
    return message + meant


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
