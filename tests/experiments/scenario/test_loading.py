"""The schema that editors follow: complete, current, and pointed at by the scenarios shipped."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from experiments.scenario.loading import scenario_of, schema_text
from mapfusion.errors import InputError

SCENARIOS = Path(__file__).parents[3] / "scenarios"
SCHEMA = json.loads(schema_text())


def fields() -> Iterator[tuple[str, dict[str, Any]]]:
    for section, described in SCHEMA["$defs"].items():
        for name, field in described.get("properties", {}).items():
            yield f"{section}.{name}", field


def numbers(node: Any) -> Iterator[dict[str, Any]]:
    if isinstance(node, dict):
        if node.get("type") in {"integer", "number"} and "const" not in node:
            yield node
        node = list(node.values())
    for each in node if isinstance(node, list) else []:
        yield from numbers(each)


def test_every_field_has_a_description_and_every_number_a_range_and_a_unit() -> None:
    seen = 0
    for name, field in fields():
        seen += 1
        assert len(field["description"]) >= 10, name
        for number in numbers({key: field[key] for key in field.keys() - {"default"}}):
            assert number["minimum"] < number["maximum"], name
            assert field["description"].endswith("]"), f"{name}: has no unit"
    assert seen > 200


def test_the_file_that_editors_read_is_current() -> None:
    remedy = "mapfusion scenarios --schema > scenarios/schema.json"
    assert (SCENARIOS / "schema.json").read_text() == schema_text(), remedy


@pytest.mark.parametrize("path", sorted(SCENARIOS.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_scenarios_name_it(path: Path) -> None:
    first = path.read_text().partition("\n")[0]
    assert (path.parent / first.removeprefix("# yaml-language-server: $schema=")).is_file()


def bounded() -> Iterator[tuple[str, str, float]]:
    """Section, field and number of all plain numeric fields, just outside their ranges."""
    for name, field in fields():
        for number in numbers([field, *field.get("anyOf", [])]):
            if number is field or number in field.get("anyOf", []):
                step = 1 if number["type"] == "integer" else 1e-6 * max(abs(number["maximum"]), 1)
                yield (*name.split("."), number["maximum"] + step)
                yield (*name.split("."), number["minimum"] - step)


PLACES = {
    "Acceptance": "align.acceptance",
    "Align": "align",
    "AttitudeNoise": "attitude",
    "BodySway": "drive.body_sway",
    "AlignerEntry": "align.aligners.0",
    "Bound": "expect.path_rmse_m",
    "Drive": "drive",
    "DriverSettings": "drive.control",
    "Evaluate": "evaluate",
    "EvidenceParameters": "align.evidence",
    "FastSlamParameters": "slam.filter",
    "FrontEndParameters": "vision",
    "Fuse": "fuse",
    "Generate": "generate",
    "HarrisParameters": "vision.harris",
    "HeightGate": "align.refinement.height",
    "Keep": "keep",
    "LoopTest": "merge.parameters.team.loop",
    "MatchParameters": "align.match",
    "MergeParameters": "merge.parameters",
    "MotionNoise": "slam.filter.motion",
    "OdometryNoise": "odometry",
    "RadiometricNoise": "radiometry",
    "Refinement": "align.refinement",
    "Simulation": "",
    "Slam": "slam",
    "Smooth": "smooth",
    "StereoCamera": "camera",
    "StereoParameters": "vision.stereo",
    "Texture": "generate.world.texture",
    "TrackParameters": "vision.tracks",
    "USurfParameters": "vision.usurf",
    "World": "generate.world",
    "LinkParameters": "team.link",
}
WRITTEN_BY_US = {"Generated", "GeneratedScenario", "Recording", "Robot"}


def test_what_lies_outside_a_range_is_refused_by_name() -> None:
    tried = 0
    for section, name, value in bounded():
        if section in WRITTEN_BY_US:
            continue
        data: dict[str, Any] = {"schema_version": 1, "name": "x", "drive": {"frames": 9}}
        data |= {"generate": {}, "align": {"aligners": [{"name": "ransac", "method": "ransac"}]}}
        node: Any = data
        for part in filter(None, PLACES[section].split(".")):
            node = node[0] if part == "0" else node.setdefault(part, {})
        node[name] = value
        with pytest.raises(InputError) as told:
            scenario_of(data, "file.yaml")
        assert f"{name}: is {value}, must be in [" in str(told.value)
        tried += 1
    assert tried > 150
