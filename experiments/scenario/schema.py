"""The JSON schema of scenarios, which editors follow: `scenarios/schema.json`."""

import inspect
import json
import re
from typing import Any

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema

from experiments.scenario.settings import GeneratedScenario, Recording, Simulation

# "name, other: text", further lines indented.
_ENTRY = re.compile(r"^    (\w+(?:, \w+)*): (.+(?:\n {5,}.+)*)", re.MULTILINE)


class _Described(GenerateJsonSchema):
    """Adds to each field what its class says of it under `Attributes:`, and its unit."""

    def model_schema(self, schema: Any) -> dict[str, Any]:
        return _described(super().model_schema(schema), schema["cls"])

    def dataclass_schema(self, schema: Any) -> dict[str, Any]:
        return _described(super().dataclass_schema(schema), schema["cls"])


def schema_text() -> str:
    """The schema, as JSON that ends with a line break."""
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
        field.pop("title", None)  # the name once more
    return schema


def attributes_of(owner: type) -> dict[str, str]:
    """What the docstrings of a class and its bases say of each attribute, on one line each."""
    found: dict[str, str] = {}
    for kind in reversed(owner.__mro__):
        text = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")[2]
        for names, about in _ENTRY.findall(text):
            found |= dict.fromkeys(names.split(", "), " ".join(about.split()))
    return found


def _units(node: Any) -> list[str]:
    """Units of all numbers in a field, which the ranges leave in its schema."""
    if isinstance(node, list):
        return [unit for each in node for unit in _units(each)]
    if not isinstance(node, dict):
        return []
    own = [node.pop("unit")] if "unit" in node else []
    return own + [unit for each in node.values() for unit in _units(each)]
