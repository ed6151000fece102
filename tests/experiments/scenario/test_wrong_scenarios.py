"""All errors of a scenario are reported at once, with line, key and remedy."""

import json
import os
import threading
import time
from pathlib import Path

import pytest

from experiments.scenario.loading import default_settings, load_scenario
from experiments.scenario.suite import parse_seeds
from experiments.scenario.yaml_files import apply_overrides, parse_value, read_mapping
from mapfusion.errors import InputError, InputErrors
from tests.helpers.tiny_scenario import TINY

WRONG = """
schema_version: 1
name: wrong
camera:
  focal_px: true
  width_px: '320'
drive: {frames: '44', frame_interval_s: 77}
world:
  walls:
  - points: [[0, 0], [1, x]]
robots:
- name: R1
  start: [0, 0, 0]
  route: [[1.5, 2]]
  loop: 1
  colour: red
evaluate: {every: 7}
fuse: {every: 10}
expect:
  path_rmse: {max: 1}
  nope.scatter_m: {max: 1}
  nobody.coverage_95: {max: 1}
merge: {aligner: icp}
seed: true
"""


def told(tmp_path: Path, text: str, *overrides: str) -> list[str]:
    """Lines that a scenario is refused in, without its file's name."""
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(InputErrors) as refused:
        load_scenario(path, overrides)
    lines = str(refused.value).splitlines()
    assert all(line.startswith(str(path)) for line in lines)
    return [line.removeprefix(str(path)) for line in lines]


def test_every_error_is_told_with_its_line(tmp_path: Path) -> None:
    found = told(tmp_path, WRONG, "slam.min_count=0")
    expected = [
        ", line 16: robots.0.colour: unknown key",
        ", --set slam.min_count=0: slam.min_count: is 0, must be in [1, 1000000] sightings",
        ", line 5: camera.focal_px: is true, expected a number",
        ", line 6: camera.width_px: is '320', expected an integer",
        ", line 7: drive.frames: is '44', expected an integer",
        ", line 7: drive.frame_interval_s: is 77, must be in [0.016, 2] s",
        ", line 10: world.walls.0.points.1.1: is 'x', expected a number",
        ", line 15: robots.0.loop: is 1, expected true or false",
        ", line 24: seed: is true, expected an integer",
        ", line 18: fuse.every: is 10, must be a multiple of evaluate.every (7 frames)",
        ", line 20: expect.path_rmse: unknown; did you mean path_rmse_m",
        ", line 21: expect.nope.scatter_m: unknown aligner nope; align.aligners has ransac",
        ", line 22: expect.nobody.coverage_95: unknown fuser nobody; fuse.fusers has kalman",
    ]
    for line in expected:
        assert any(each.startswith(line) for each in found), line
    assert len(found) == len(expected)


def test_what_hangs_together_is_told_when_all_else_is_right(tmp_path: Path) -> None:
    overrides = ("merge.aligner=nobody", "merge.fuser=none", "fuse.every=3", "evaluate.every=2")
    found = told(tmp_path, TINY, *overrides)
    for words in ("merge.aligner: nobody is not", "merge.fuser: none is not", "fuse.every: is 3"):
        assert sum(words in line for line in found) == 1
    assert len(found) == 3


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("seed=18446744073709551616", "an integer of 65 bits, 63 are the most"),
        ("seed=9223372036854775808", "an integer of 64 bits, 63 are the most"),
        ("seed=9223372036854775807", "seed: is 9223372036854775807, must be in [0, 4294967295]"),
        ("seed=4294967296", "seed: is 4294967296, must be in [0, 4294967295]"),
        ("seed=-1", "seed: is -1, must be in"),
        ("seed=1.5", "seed: is 1.5, expected an integer"),
        ("seed='1'", "seed: is '1', expected an integer"),
        ("seed=null", "seed: is null, expected an integer"),
        ("slam=[1]", "slam: is [1], expected a mapping"),
        ("slam=5", "slam: is 5, expected a mapping"),
        ("tags=x", "tags: is 'x', expected a list"),
        ("align.match.max_descriptor_distance=true", "expected a number"),
        ("description=5", "description: is 5, expected a text"),
    ],
)
def test_a_wrong_type_or_size_is_refused(override: str, said: str) -> None:
    with pytest.raises(InputError) as refused:
        default_settings([override])
    assert said in str(refused.value)


def test_whole_numbers_may_be_written_with_a_point_and_integers_stand_for_numbers() -> None:
    # JSON schemas, which editors follow, count 5.0 as an integer
    settings = default_settings(["evaluate.every=5.0", "evaluate.true_pair_radius_m=1"])
    assert settings.evaluate.every == 5
    assert settings.evaluate.true_pair_radius_m == 1.0


@pytest.mark.parametrize("value", [2**63 - 1, -(2**63) + 1])
def test_the_largest_integers_are_read(value: int) -> None:
    assert parse_value(str(value), "--set x") == value


def test_seeds_beyond_all_bounds_are_one_line() -> None:
    with pytest.raises(InputError, match="more than 1000 seeds"):
        parse_seeds("0..18446744073709551616")
    (seed,) = parse_seeds("18446744073709551616")
    with pytest.raises(InputError, match="seed: is 18446744073709551616, must be in"):
        default_settings([], seed)


def test_an_entry_that_a_list_does_not_have_is_refused_with_those_it_has() -> None:
    robots = {"robots": [{"name": "R1"}, {"name": "R2"}]}
    for place in ("2", "9" * 5000, "-1", "R1", "٣"):
        with pytest.raises(InputError, match=r"no such entry; there: 0 \(R1\), 1 \(R2\)$"):
            apply_overrides(robots, [f"robots.{place}.name=x"])
    changed = apply_overrides(robots, ["robots.1.name=x"])
    assert [robot["name"] for robot in changed["robots"]] == ["R1", "x"]
    with pytest.raises(InputError, match="there: none"):
        apply_overrides({"robots": []}, ["robots.0.name=x"])
    with pytest.raises(InputError, match="y is not a key here, where the value 5 stands"):
        apply_overrides({"x": 5}, ["x.y=1"])


def test_a_very_large_scenario_is_refused_soon(tmp_path: Path) -> None:
    wall = "  - points: [[1.5, 0.25], [1.5, 3.75]]\n"
    path = tmp_path / "large.yaml"
    path.write_text("schema_version: 1\nname: large\nworld:\n  walls:\n" + 20_000 * wall)
    started_s = time.process_time()
    with pytest.raises(InputError, match="holds more than 20000 values in YAML; write it as JSON"):
        read_mapping(path)
    assert time.process_time() - started_s < 5


def test_json_is_read_as_yaml_is(tmp_path: Path) -> None:
    walls = [{"points": [[float(i), 0.25], [float(i), 3.75]]} for i in range(20_000)]
    path = tmp_path / "large.json"
    path.write_text(json.dumps({"name": "large", "world": {"walls": walls}}))
    assert read_mapping(path)["world"]["walls"] == walls
    for text, said in (
        ('{"a": 1, "a": 2}', "duplicate key"),
        ('{"a": ' * 60 + "1" + "}" * 60, "nested too deeply"),
        ('{"a": "\\ud800"}', "holds a character that no file can"),
        ('{"a": 18446744073709551616}', "65 bits"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=said):
            read_mapping(path)
    path.write_text('{"a": NaN, "b": 1e3}')  # of YAML the first is a text
    assert read_mapping(path) == {"a": "NaN", "b": 1000.0}


@pytest.mark.parametrize("text", ["[1, 2]", "5", "null", '"x"'])
def test_a_result_file_that_is_no_object_says_what_it_holds(tmp_path: Path, text: str) -> None:
    from mapfusion.files import read_json

    path = tmp_path / "scenario.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"no JSON object \(it holds") as e:
        read_json(path, "resolved scenario")
    assert "operand" not in str(e.value)


def test_a_pipe_is_read_once(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    writer = threading.Thread(target=path.write_text, args=(WRONG,), daemon=True)
    writer.start()
    with pytest.raises(InputErrors, match=r"pipe: camera\.focal_px: is true, expected"):
        load_scenario(path)
    writer.join()


@pytest.mark.parametrize(
    ("name", "override", "said"),
    [
        ("apart", "robots.0.name=A", "this scenario has generate, and no robots; leave it out"),
        ("mrclam7", "drive.frames=9", "this scenario has logs, and no drive; leave it out"),
    ],
)
def test_a_section_of_another_kind_of_scenario(name: str, override: str, said: str) -> None:
    path = Path(__file__).parents[3] / "scenarios" / f"{name}.yaml"
    with pytest.raises(InputError, match=rf"yaml, --set {override}: {said} \(give either world"):
        load_scenario(path, [override])
