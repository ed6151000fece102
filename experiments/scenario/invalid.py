"""What is wrong with a scenario, in one line: the field, and what would be right."""

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, ValidationError

_MOST_SUGGESTED = 3  # keys that an error message offers


def first_problem(kind: type[BaseModel], error: ValidationError) -> str:
    """The first thing that is wrong with a section, and how many more there are."""
    problems = error.errors(include_url=False)
    # A wrong name explains the missing one that follows from it, so it goes first.
    unknown = [
        p for p in problems if p["type"] in {"extra_forbidden", "unexpected_keyword_argument"}
    ]
    problem = (unknown or problems)[0]
    where = ".".join(str(part) for part in problem["loc"])
    message = problem["msg"].removeprefix("Value error, ")
    if unknown:
        message = f"unknown key; known here: {', '.join(_siblings(kind, problem['loc']))}"
        elsewhere = _paths_like(kind, str(problem["loc"][-1]))
        message += f"; did you mean {' or '.join(elsewhere)}?" if elsewhere else ""
    elif problem["type"] != "value_error" and not isinstance(problem["input"], dict):
        message = f"{message} (it is {problem['input']!r})"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{where}: {message}{more}" if where else f"{message}{more}"


def _siblings(kind: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The names that would have been right beside an unknown one, from the JSON schema."""
    root = kind.model_json_schema()
    node: dict[str, Any] = root
    for part in location[:-1]:
        node = _resolved_node(root, node)
        if isinstance(part, int):
            node = node["items"]
        else:  # a mapping with free keys, as `expect`, describes all its values at once
            node = node.get("properties", {}).get(part) or node["additionalProperties"]
    return sorted(_resolved_node(root, node)["properties"])


def _paths_like(kind: type[BaseModel], name: str) -> list[str]:
    """Dotted keys, wherever they are, whose last part holds this name as a word: n_particles."""
    root = kind.model_json_schema()

    def below(node: dict[str, Any], prefix: str) -> Iterator[str]:
        for key, child in _resolved_node(root, node).get("properties", {}).items():
            if name in key.split("_"):
                yield prefix + key
            yield from below(child, f"{prefix}{key}.")

    return list(below(root, ""))[:_MOST_SUGGESTED]


def _resolved_node(root: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    for option in node.get("anyOf", []):
        if "$ref" in option:
            node = option
    reference = node.get("$ref")
    return root["$defs"][reference.rsplit("/", 1)[1]] if reference else node
