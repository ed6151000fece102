"""Safe YAML 1.2 files as plain mappings; errors name file and line."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, MaxDepthExceededError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode

from mapfusion.errors import InputError
from mapfusion.files import SEAL

SHIPPED = Path(__file__).with_name("shipped")  # the repository's scenarios/, also where installed
OWN = Path("scenarios")  # what shipped files name lies beside it, as it does in the repository
_MOST_BYTES = 4_000_000  # the largest resolved scenario of ours takes 0.03 of that
_MOST_VALUES = 200_000  # with every alias written out
# The reader takes a second for 5 000 to 10 000 values; the 1000 walls that a world may have, of two
# points each, are 9 000. JSON is read a hundred times as fast, and has no such limit.
_MOST_WRITTEN = 20_000
_MOST_DEPTH = 50  # a scenario needs 8
_TOO_DEEP = "nested too deeply, or holds itself"
_OPENCV_HEADER = "%YAML:1.0"  # of its own dialect, which only looks like a YAML directive
_LARGEST_INTEGER = 2**63  # what tables and other people's readers of JSON can hold


class _Counting(Composer):
    """Gives up after so many values, before it has read all of a long text."""

    n_values = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.n_values += 1
        if self.n_values > _MOST_WRITTEN:
            remedy = "write it as JSON, which is read faster, or make it smaller"
            raise InputError(f"holds more than {_MOST_WRITTEN} values in YAML; {remedy}")
        return super().compose_node(parent, index)


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
    known, value = _as_json(text)
    if known:
        return _plain(value, where, ())
    reader = _reader()
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


def _reader() -> YAML:
    reader = YAML(typ="safe", pure=True)
    reader.Composer = _Counting
    reader.max_depth = _MOST_DEPTH  # given up there: to read all of a deep text takes seconds
    return reader


def _as_json(text: str) -> tuple[bool, Any]:
    """Read a text as a JSON object, if it is one.

    All other texts are left to the reader of YAML, with what only that one refuses: keys that are
    there twice, deep nesting, numbers that JSON does not know.
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
    return _depth_of(value) <= _MOST_DEPTH, value


def _depth_of(value: Any) -> int:
    """Levels of mappings and lists, as far as they count."""
    level, depth = [value], 0
    while level and depth <= _MOST_DEPTH:
        depth += 1
        level = [
            below
            for each in level
            if isinstance(each, dict | list)
            for below in (each.values() if isinstance(each, dict) else each)
        ]
    return depth


def lines_of_keys(path: Path) -> dict[tuple[str | int, ...], int]:
    """Line number of each key and list item of a YAML file, by its path; none if unreadable."""
    if not path.is_file():  # a pipe, which can be read once only
        return {}
    try:
        text = path.read_text(encoding="utf-8").removeprefix(_OPENCV_HEADER)
        node = _reader().compose(text)
        return {} if node is None else dict(_marked(node, ()))
    except Exception:  # what cannot be read has been refused before, or is too long
        return {}


def _marked(node: Node, path: tuple[str | int, ...]) -> Iterator[tuple[tuple[str | int, ...], int]]:
    """Paths and lines of all keys and items below a node; of an alias, those of its anchor."""
    if isinstance(node, MappingNode):
        items = [(key.value, key, value) for key, value in node.value]
    else:
        items = [(i, value, value) for i, value in enumerate(_children(node))]
    for name, marked, value in items:
        yield (*path, name), marked.start_mark.line + 1
        if not isinstance(value, ScalarNode):
            yield from _marked(value, (*path, name))


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
