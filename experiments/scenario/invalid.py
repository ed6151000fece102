"""What is wrong with a scenario, in one line: the field, and what would be right."""

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import ValidationError

_MOST_SUGGESTED = 3  # keys that an error message offers
_UNKNOWN = {"extra_forbidden", "unexpected_keyword_argument"}


def first_problem(schema: dict[str, Any], error: ValidationError) -> str:
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
