"""Units in the names of columns, and what to do with columns of a similar name or another unit."""

import re
from collections.abc import Mapping

UNIT = re.compile(
    r"_?(\[.*\]|\(.*\)|(?:(?<=_)|^)(?:rad|deg|[mck]?m)_s|km_?h|degps|[mck]?m2?|met(er|re)s?|ft|feet"
    r"|[mun]?s|rad(ian)?s?|deg(ree)?s?|px)$"
)
_SPELLINGS: dict[str, str] = dict.fromkeys(("meter", "meters", "metre", "metres"), "m")
_SPELLINGS |= {"feet": "ft", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad"}
_SPELLINGS |= {"°": "deg", "sec": "s", "seconds": "s", "degps": "deg_s"}
_UNIT_NAMES = {"deg": "degrees", "mm": "millimetres", "cm": "centimetres", "ft": "feet"}
_UNIT_NAMES |= {"km_h": "kilometres per hour", "kmh": "kilometres per hour"}
_UNIT_NAMES |= {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_UNIT_NAMES |= {"deg_s": "degrees per second", "km": "kilometres", "m": "metres", "s": "seconds"}
# What numbers of a unit are multiplied by, by the unit and the needed unit.
_CONVERSIONS = {
    ("deg", "rad"): "pi/180",
    ("deg_s", "rad_s"): "pi/180",
    ("mm", "m"): "0.001",
    ("cm", "m"): "0.01",
    ("km", "m"): "1000",
    ("ft", "m"): "0.3048",
    ("mm2", "m2"): "1e-6",
    ("cm2", "m2"): "1e-4",
    ("mm_s", "m_s"): "0.001",
    ("cm_s", "m_s"): "0.01",
    ("km_h", "m_s"): "1/3.6",
    ("kmh", "m_s"): "1/3.6",
    ("ms", "s"): "0.001",
    ("us", "s"): "1e-6",
    ("ns", "s"): "1e-9",
}
_MAX_NAMED = 3  # columns with similar names in one message


def plain_name(name: str) -> str:
    """Return a name in lower case, with an underscore for each blank or hyphen."""
    return re.sub(r"[\s-]+", "_", name.strip().lower())


def renaming(similar: Mapping[str, str]) -> str:
    """Return what to do with columns of similar names, given by the known name.

    Numbers in another unit must be converted, not only renamed.
    """
    converted, renamed = [], []
    for name, there in similar.items():
        unit, needed = _unit_of(there), _unit_of(name)
        factor, called = _CONVERSIONS.get((unit, needed)), _UNIT_NAMES.get(unit, unit)
        if factor:
            converted.append(f"{there} is in {called}: multiply by {factor} and name it {name}")
        elif unit and unit != needed:
            converted.append(f"{there} is in {called}: convert it and name it {name}")
        else:
            renamed.append(f"{there} to {name}")
    asked = [f"rename column {' and '.join(renamed[:_MAX_NAMED])} (mind the unit)"]
    more = ", ..." if max(len(renamed), len(converted)) > _MAX_NAMED else ""
    return "; ".join([*converted[:_MAX_NAMED], *(asked if renamed else [])]) + more


def _unit_of(name: str) -> str:
    """Return the unit at the end of a column's name, in one spelling; empty if there is none."""
    match = UNIT.search(plain_name(name))
    unit = match[0].strip("_[]() ") if match else ""
    return _SPELLINGS.get(unit, unit)
