"""Scenario files: safe YAML 1.2 in, plain mappings out, one clear line when that fails."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from mapfusion.errors import InputError
from mapfusion.sealed import SEAL


def read_mapping(path: Path) -> dict[str, Any]:
    """Read one YAML mapping; raises InputError that names the file and the line."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        expected = "expected a scenario, for example quick.yaml"
        raise InputError(f"{path}: no such file ({expected})") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as UTF-8 text ({error})") from error
    data = parse_value(text, str(path))
    if not isinstance(data, dict):
        found = "nothing" if data is None else f"a {type(data).__name__}"
        raise InputError(f"{path}: holds {found}, expected a mapping of scenario keys")
    data.pop(SEAL, None)  # of a result's scenario.json, which may have been edited
    return data


def parse_value(text: str, where: str) -> Any:
    """Read one YAML value; raises InputError that begins with `where`."""
    try:
        return _copied(YAML(typ="safe", pure=True).load(text))
    except (YAMLError, ValueError) as error:  # the latter for example of an impossible date
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        problem = str(getattr(error, "problem", None) or error).splitlines()[0]
        raise InputError(f"{where}{line}: not plain YAML ({problem})") from error
    except RecursionError as error:
        raise InputError(f"{where}: nested too deeply, or holds itself") from error


def apply_overrides(data: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a copy with `key.sub=value` entries set; values are YAML, list items go by index."""
    result = _copied(data)
    for override in overrides:
        dotted, separator, value = override.partition("=")
        if not separator or not dotted:
            raise InputError(f"--set {override}: expected key=value, for example evaluate.every=1")
        _assign(result, dotted, parse_value(value, f"--set {override}"))
    return result


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _copied(v) for k, v in value.items()}
    return [_copied(v) for v in value] if isinstance(value, list) else value


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
    if isinstance(node, list) and name.isdigit() and int(name) < len(node):
        return int(name)
    raise InputError(f"--set {dotted}: {name} is not a key here")
