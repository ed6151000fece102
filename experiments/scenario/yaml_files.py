"""Safe YAML 1.2 files as plain mappings; errors name file and line."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, MaxDepthExceededError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode

from mapfusion.errors import InputError

SHIPPED = Path(__file__).with_name("shipped")  # the repository's scenarios/, also when installed
OWN = Path("scenarios")  # shipped files name their logs relative to this folder
_MOST_BYTES = 4_000_000  # 30 times the largest resolved scenario of the suite
_MOST_VALUES = 200_000  # values with all aliases expanded
# Values in a YAML file. The largest world (1000 walls of two points) needs 9 000. The YAML reader
# is slow: more values take several seconds. The JSON reader is fast and has no such limit.
_MOST_WRITTEN = 20_000
_MOST_DEPTH = 50  # nested levels; a scenario needs 8
_TOO_DEEP = "nested too deeply, or holds itself"
_OPENCV_HEADER = "%YAML:1.0"  # OpenCV's files begin so; it is not a valid YAML directive
_OPENCV_TAG = "!!opencv-matrix"  # its matrices are mappings
_LARGEST_INTEGER = 2**63  # the limit of tables and of most JSON readers


class _Counting(Composer):
    """Composer that stops reading after `_MOST_WRITTEN` values."""

    n_values = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.n_values += 1
        if self.n_values > _MOST_WRITTEN:
            remedy = "write it as JSON, which is read faster, or make it smaller"
            raise InputError(f"holds more than {_MOST_WRITTEN} values in YAML; {remedy}")
        return super().compose_node(parent, index)


_SCENARIO = "a scenario; `mapfusion scenarios` lists the shipped ones, which have no ending"


def read_mapping(path: Path, what: str = _SCENARIO, keys: str = "scenario keys") -> dict[str, Any]:
    """Read one mapping from a YAML or JSON file.

    Args:
        path: the file.
        what: the expected content, for error messages.
        keys: the expected keys, for error messages.

    Raises:
        InputError: the file cannot be read; names the file and the line.
    """
    try:
        with path.open("rb") as file:  # a pipe has no size to check
            data = file.read(_MOST_BYTES + 1)
        text = data.decode("utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file (expected {what})") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as UTF-8 text ({error})") from error
    if len(data) > _MOST_BYTES:
        raise InputError(f"{path}: is larger than {_MOST_BYTES / 1e6:g} MB, none is")
    plain = text.removeprefix(_OPENCV_HEADER).replace(_OPENCV_TAG, "")
    value = parse_value(plain, str(path))
    if not isinstance(value, dict):
        found = "nothing" if value is None else f"a {type(value).__name__}"
        raise InputError(f"{path}: holds {found}, expected a mapping of {keys}")
    if text.lstrip().startswith("{"):
        from mapfusion.files import DIGEST

        value.pop(DIGEST, None)  # of a result's scenario.json, which may have been edited
    return value


def read_calibration(path: Path) -> dict[str, Any]:
    """Read a camera calibration from a YAML or JSON file.

    Raises:
        InputError: the file cannot be read; names the file and the line.
    """
    return read_mapping(path, "a calibration in YAML", "a calibration's keys")


def parse_value(text: str, where: str) -> Any:
    """Read one YAML or JSON value: mappings, lists, texts, numbers, true, false or null.

    Args:
        text: the text to read.
        where: the source of the text, with which error messages begin.

    Raises:
        InputError: the text is not plain YAML, or it is too large.
    """
    is_json, value = _as_json(text)
    if is_json:
        return _plain(value, where, ())
    reader = _reader()
    try:
        node = reader.compose(text)
        if node is None:
            return None
        _count_values(node, {})
        value = reader.constructor.construct_document(node)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except MaxDepthExceededError as error:
        raise InputError(f"{where}: {_TOO_DEEP}") from error
    except Exception as error:  # the reader raises many types if a tag does not fit its value
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        problem = str(getattr(error, "problem", None) or error).partition("\n")[0]
        raise InputError(f"{where}{line}: not plain YAML ({problem})") from error
    return _plain(value, where, ())


def _reader() -> YAML:
    reader = YAML(typ="safe", pure=True)
    reader.Composer = _Counting
    reader.max_depth = _MOST_DEPTH
    return reader


def _as_json(text: str) -> tuple[bool, Any]:
    """Read a text that is a JSON object; return True and its value.

    Return False for all other texts: the YAML reader accepts or refuses them. These include objects
    with repeated keys, very deep nesting and numbers that are not JSON.
    """
    if not text.lstrip().startswith("{"):
        return False, None

    def object_of(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise ValueError("a key is there twice")
        return found

    def no_number(name: str) -> Any:
        raise ValueError(f"{name} is no number of JSON")

    try:
        value = json.loads(text, object_pairs_hook=object_of, parse_constant=no_number)
    except (ValueError, RecursionError):
        return False, None
    return True, value


def lines_of_keys(path: Path) -> dict[tuple[str | int, ...], int]:
    """Return the line number of each key and list item; empty if the file cannot be read."""
    if not path.is_file():  # a pipe can be read only once
        return {}
    try:
        text = path.read_text(encoding="utf-8").removeprefix(_OPENCV_HEADER)
        node = _reader().compose(text)
        return {} if node is None else dict(_marked(node, ()))
    except Exception:  # unreadable files have been refused before
        return {}


def _marked(node: Node, path: tuple[str | int, ...]) -> Iterator[tuple[tuple[str | int, ...], int]]:
    """Yield the path and line of each key and item below a node; an alias has its anchor's."""
    if isinstance(node, MappingNode):
        items = [(key.value, key, value) for key, value in node.value]
    else:
        items = [(i, value, value) for i, value in enumerate(_children(node))]
    for name, marked, value in items:
        yield (*path, name), marked.start_mark.line + 1
        if not isinstance(value, ScalarNode):
            yield from _marked(value, (*path, name))


def _count_values(node: Node, counts: dict[int, int]) -> int:
    """Count the values of a node with all aliases expanded, before any value is made.

    Args:
        node: the node.
        counts: counts of earlier nodes by their ids; an alias is the node of its anchor.

    Raises:
        InputError: there are too many values, or the node contains itself.
    """
    if id(node) not in counts:
        counts[id(node)] = 0  # not known yet
        counts[id(node)] = 1 + sum(_count_values(each, counts) for each in _children(node))
    n_values = counts[id(node)]
    if n_values == 0:
        raise InputError(_TOO_DEEP)
    if n_values > _MOST_VALUES:
        raise InputError(f"holds more than {_MOST_VALUES} values, aliases written out")
    return n_values


def _children(node: Node) -> Iterator[Node]:
    if isinstance(node, MappingNode):
        for pair in node.value:
            yield from pair
    elif not isinstance(node, ScalarNode):
        yield from node.value


def _plain(value: Any, where: str, path: tuple[str, ...]) -> Any:
    """Copy a value without aliases; raise InputError for values that JSON or tables cannot hold."""
    if len(path) > _MOST_DEPTH:
        raise InputError(f"{where}: {_TOO_DEEP}")
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
    """Return a copy with each override `key.sub=value` applied.

    Values are YAML. List items are named by their index.

    Raises:
        InputError: an override has no value or names a missing list item.
    """
    result = _plain(data, "scenario", ())
    for override in overrides:
        dotted, separator, value = override.partition("=")
        if not separator or not dotted:
            raise InputError(f"--set {override}: expected key=value, for example evaluate.every=1")
        parsed = parse_value(value, f"--set {override}")
        node: Any = result
        *parents, last = dotted.split(".")
        for name in parents:
            key = _key(node, name, dotted)
            if isinstance(node, dict) and node.get(key) is None:
                node[key] = {}
            node = node[key]
        node[_key(node, last, dotted)] = parsed
    return result


def _key(node: Any, name: str, dotted: str) -> str | int:
    """Return the mapping key or list index of one part of a dotted name."""
    if isinstance(node, dict):
        return name
    if isinstance(node, list):
        places = {str(place): place for place in range(len(node))}
        if name in places:
            return places[name]
        named = [each.get("name") if isinstance(each, Mapping) else None for each in node]
        there = ", ".join(
            f"{place} ({called})" if isinstance(called, str) else place
            for place, called in zip(places, named, strict=True)
        )
        raise InputError(f"--set {dotted}: {name}: no such entry; there: {there or 'none'}")
    held = "null" if node is None else f"the value {node!r}"
    raise InputError(f"--set {dotted}: {name} is not a key here, where {held} stands")
