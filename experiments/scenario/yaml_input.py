"""Scenario files: safe YAML 1.2 in, plain mappings out, one clear line when that fails."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import MaxDepthExceededError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode

from mapfusion.errors import InputError
from mapfusion.sealed import SEAL

_MOST_BYTES = 4_000_000  # the largest resolved scenario of ours takes 0.03 of that
_MOST_VALUES = 200_000  # with every alias written out
_MOST_DEPTH = 50  # a scenario needs 8
_TOO_DEEP = "nested too deeply, or holds itself"
_OPENCV_HEADER = "%YAML:1.0"  # of its own dialect, which only looks like a YAML directive
_LARGEST_INTEGER = 2**63  # what tables and other people's readers of JSON can hold


def read_mapping(
    path: Path, what: str = "a scenario, for example quick.yaml", keys: str = "scenario keys"
) -> dict[str, Any]:
    """Read one YAML mapping, of `what` with its `keys`.

    Raises:
        InputError: names the file and the line.
    """
    try:
        with path.open("rb") as file:  # not by its size: a pipe has none
            data = file.read(_MOST_BYTES + 1)
        text = data.decode("utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file (expected {what})") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as UTF-8 text ({error})") from error
    if len(data) > _MOST_BYTES:
        raise InputError(f"{path}: is larger than {_MOST_BYTES / 1e6:g} MB, none is")
    value = parse_value(text.removeprefix(_OPENCV_HEADER), str(path))
    if not isinstance(value, dict):
        found = "nothing" if value is None else f"a {type(value).__name__}"
        raise InputError(f"{path}: holds {found}, expected a mapping of {keys}")
    value.pop(SEAL, None)  # of a result's scenario.json, which may have been edited
    return value


def read_calibration(path: Path) -> dict[str, Any]:
    """Read a camera's calibration; raises InputError that names the file and the line."""
    return read_mapping(path, "a calibration in YAML", "a calibration's keys")


def parse_value(text: str, where: str) -> Any:
    """Read one YAML value: mappings with texts as keys, lists, texts, numbers, truth values, null.

    Raises:
        InputError: one line that begins with `where`.
    """
    reader = YAML(typ="safe", pure=True)
    reader.max_depth = _MOST_DEPTH  # given up there: to read all of a deep text takes seconds
    try:
        node = reader.compose(text)
        if node is None:
            return None
        _measured(node, {})
        value = reader.constructor.construct_document(node)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except MaxDepthExceededError as error:
        raise InputError(f"{where}: {_TOO_DEEP}") from error
    except Exception as error:  # the reader leaves by any door where a tag does not fit its value
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        problem = str(getattr(error, "problem", None) or error).partition("\n")[0]
        raise InputError(f"{where}{line}: not plain YAML ({problem})") from error
    return _plain(value, where, ())


def _measured(node: Node, known: dict[int, tuple[int, int]], depth: int = 0) -> tuple[int, int]:
    """How many values a node stands for, and how deep they are nested, before any is made.

    `known` keeps what was counted, by the nodes' ids: an alias is its anchor's node once more.

    Raises:
        InputError: too many or too deep.
    """
    if id(node) not in known and depth <= _MOST_DEPTH:
        below = [_measured(each, known, depth + 1) for each in _children(node)]
        size, height = 1 + sum(n for n, _ in below), 1 + max((h for _, h in below), default=0)
        known[id(node)] = size, height
    size, height = known.get(id(node), (0, _MOST_DEPTH + 1))
    if height > _MOST_DEPTH:
        raise InputError(_TOO_DEEP)
    if size > _MOST_VALUES:
        raise InputError(f"holds more than {_MOST_VALUES} values, aliases written out")
    return size, height


def _children(node: Node) -> Iterator[Node]:
    if isinstance(node, MappingNode):
        for pair in node.value:
            yield from pair
    elif not isinstance(node, ScalarNode):
        yield from node.value


def _plain(value: Any, where: str, path: tuple[str, ...]) -> Any:
    """A copy without aliases; raises InputError for what JSON, tables and names cannot hold."""
    place = f"{where}: {'.'.join(path)}" if path else where
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise InputError(f"{place}: the key {key!r} is no text; put it in quotes")
            _require_text(key, place)
        return {key: _plain(each, where, (*path, key)) for key, each in value.items()}
    if isinstance(value, list):
        return [_plain(each, where, (*path, str(i))) for i, each in enumerate(value)]
    if isinstance(value, str):
        _require_text(value, place)
    elif isinstance(value, int):
        if abs(value) >= _LARGEST_INTEGER:
            raise InputError(f"{place}: an integer of {value.bit_length()} bits, 63 are the most")
    elif not isinstance(value, float | None):
        raise InputError(f"{place}: {value!s} is a {type(value).__name__}; put it in quotes")
    return value


def _require_text(text: str, place: str) -> None:
    if "\0" in text or (not text.isascii() and any("\ud800" <= c <= "\udfff" for c in text)):
        raise InputError(f"{place}: {text!r} holds a character that no file can (NUL, surrogate)")


def apply_overrides(data: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a copy with `key.sub=value` entries set; values are YAML, list items go by index."""
    result = _plain(data, "scenario", ())
    for override in overrides:
        dotted, separator, value = override.partition("=")
        if not separator or not dotted:
            raise InputError(f"--set {override}: expected key=value, for example evaluate.every=1")
        _assign(result, dotted, parse_value(value, f"--set {override}"))
    return result


def _assign(data: dict[str, Any], dotted: str, value: Any) -> None:
    node: Any = data
    *parents, last = dotted.split(".")
    for name in parents:
        key = _key(node, name, dotted)
        if isinstance(node, dict) and node.get(key) is None:
            node[key] = {}
        node = node[key]
    node[_key(node, last, dotted)] = value


def _key(node: Any, name: str, dotted: str) -> str | int:
    """What a part of a dotted name stands for: a mapping's key, or the place in a list."""
    if isinstance(node, dict):
        return name
    if isinstance(node, list) and name.isdecimal() and int(name) < len(node):
        return int(name)
    here = f" (items 0 to {len(node) - 1})" if isinstance(node, list) and node else ""
    raise InputError(f"--set {dotted}: {name} is not a key here{here}")
