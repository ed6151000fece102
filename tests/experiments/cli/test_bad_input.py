"""Whatever a user gets wrong: exit code 2 and one line that says what and where."""

import json
from pathlib import Path

import pandas as pd
import pytest

from experiments.scenario.loading import load_scenario
from experiments.scenario.yaml_files import parse_value, read_mapping
from mapfusion.errors import InputError
from tests.helpers.tiny_scenario import TINY, assert_refused, command

SCENARIOS = Path(__file__).parents[3] / "scenarios"


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("slam.filter.n_particle=3", ["slam.filter.n_particle", "unknown key", "n_particles"]),
        ("bogus=1", ["bogus", "unknown key", "robots"]),
        ("vision.harris.bogus=1", ["vision.harris.bogus", "max_corners"]),
        ("expect.path_rmse_m.most=1", ["expect.path_rmse_m.most", "known here: max, min"]),
        ("slam.filter.n_particles=lots", ["slam.filter.n_particles", "integer", "'lots'"]),
        ("slam.filter.n_particles=2.5", ["slam.filter.n_particles", "integer"]),
        ("slam.filter.n_particles=0", ["slam.filter.n_particles: is 0", "[1, 10000] particles"]),
        ("slam.filter.noise_floor_m=.nan", ["slam.filter.noise_floor_m", "finite"]),
        ("slam.filter.noise_scale=4", ["slam.filter.noise_scale: retired", "slam.filter.stray_m"]),
        ("drive.frames=1", ["drive.frames: is 1", "[2, 100000] frames"]),
        ("drive.frame_interval_s=.nan", ["drive.frame_interval_s", "finite"]),
        ("drive.control.speed_m_s=9", ["speed_m_s", "0.7"]),
        ("camera.width_px=0", ["camera", "width_px", "[1, 4096]"]),
        ("camera.height_px=100000", ["camera", "height_px", "[1, 4096]"]),
        ("camera.focal_px=-1", ["camera.focal_px", "[1, 100000] px"]),
        ("camera.baseline_m=.inf", ["camera.baseline_m", "finite"]),
        ("seed=-1", ["seed: is -1", "[0, 4294967295]"]),
        ("seed=4294967296", ["seed", "[0, 4294967295]"]),
        ("schema_version=2", ["schema_version", "1"]),
        (
            "align.aligners.0.method=magic",
            ["align.aligners.0", "magic", "known are ransac, svd, icp, impicp"],
        ),
        ("align.aligners.0.parameters={bogus: 1}", ["align.aligners.0", "bogus"]),
        ("align.aligners.1.parameters={translation: no}", ["align.aligners.1", "translation"]),
        ("align.aligners.1.name=ransac", ["aligners", "two are named ransac"]),
        ("align.aligners.1.name=oracle", ["aligners.1", "oracle"]),
        ("merge.aligner=zz", ["merge.aligner", "zz", "ransac, svd"]),
        ("expect.bogus={max: 1}", ["expect.bogus", "known: path_rmse_m"]),
        ("expect.path_rmse_m={}", ["expect.path_rmse_m", "min, max or both"]),
        ("expect.path_rmse_m={min: 2, max: 1}", ["expect.path_rmse_m", "min 2 is above max 1"]),
        ("robots.1.name=R1", ["robots", "two are named R1"]),
        ("robots.0.name=../x", ["robots.0.name", "expected letters, digits"]),
        ("name=../x", ["name", "expected letters, digits"]),
        ("name=/x", ["name", "expected letters, digits"]),
        ("robots=[]", ["world, robots and drive, or logs"]),
        ("logs=[nowhere]", ["--set logs=[nowhere]: this scenario has drive and robots and world"]),
        (
            "generate.robts=3",
            ["--set generate.robts=3: this scenario has robots and world, and no generate"],
        ),
        ("world.walls.0.points=[[0, 0]]", ["world.walls.0.points", "2"]),
        ("world.walls.0.mirrored=true", ["world.walls.0", "mirrored", "needs a look"]),
        ("world.walls.0.look=a b", ["world.walls.0.look", "expected letters, digits"]),
        (
            "world.walls=[{look: a, points: [[0,0], [6,0]]}, {look: a, points: [[0,0], [5,0]]}]",
            ["world", "walls.1.points", "of the shape of walls.0", "(a)"],
        ),
        (
            "world.texture.poster_width_m=[2, 1]",
            ["world.texture", "poster_width_m: is 2 to 1", "the smallest is above the largest"],
        ),
        ("robots.0.start=[1, 1]", ["robots.0.start.2", "is missing"]),
        ("robots.9.name=x", ["--set robots.9.name", "9: no such entry; there: 0 (R1), 1 (R2)"]),
        ("robots.2.name=x", ["--set robots.2.name", "2: no such entry; there: 0 (R1), 1 (R2)"]),
        ("seed.x=1", ["--set seed.x", "x is not a key"]),
        ("x", ["--set x", "key=value"]),
        ("=1", ["--set =1", "key=value"]),
        ("drive.frames=[", ["--set drive.frames=[", "not plain YAML"]),
    ],
)
def test_wrong_value(
    tiny_path: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    override: str,
    words: list[str],
) -> None:
    results = tmp_path / "results"
    reply = command(capsys, "run", tiny_path, "--set", override, "--results", results)
    assert_refused(reply, *words)
    if not override.startswith(("x", "=", "robots.9", "robots.2", "seed.x", "drive.frames=[")):
        assert str(tiny_path) in reply.err
    assert not results.exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- 1\n- 2\n", ["holds a list", "mapping"]),
        ("", ["holds nothing", "mapping"]),
        ("name: !!python/object/apply:os.system ['true']\n", ["line 1", "python/object"]),
        (TINY + "name: again\n", ["duplicate key", '"name"']),
        ("a: [1\nb: 2\n", ["line 2", "not plain YAML"]),
        ("a:\n\tb: 1\n", ["line 2", "not plain YAML"]),
        ("a: 1\n---\nb: 2\n", ["another document"]),
        ("a: &a [*a]\n", ["holds itself"]),
        ("[" * 1500 + "]" * 1500, ["nested too deeply"]),
        (TINY + "1: 2\n", ["the key 1 is no text"]),
        (TINY + '"two\\nlines": 2\n', ["two lines", "unknown key"]),
        (TINY + "x: 2001-99-99\n", ["month"]),
    ],
)
def test_wrong_yaml(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: list[str]
) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(text, encoding="utf-8")
    assert_refused(command(capsys, "run", path), "wrong.yaml", *words)


def test_not_utf8(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_bytes(b"name: \xff\xfe\n")
    assert_refused(command(capsys, "run", path), "wrong.yaml", "UTF-8")


def test_integers_are_those_of_63_bits() -> None:
    """Return values that tables can hold, and values that are no setting."""
    for value in (2**63 - 1, 1 - 2**63):
        assert parse_value(str(value), "x") == value
    for value in (2**63, -(2**63), 2**64, 10**400):
        with pytest.raises(InputError, match=r"x: an integer of .* bits, 63 are the most"):
            parse_value(str(value), "x")


def test_values_keep_their_yaml_1_2_types(tmp_path: Path) -> None:
    path = tmp_path / "types.yaml"
    path.write_text("a: 1e-3\nb: no\nc: 010\n", encoding="utf-8")
    assert read_mapping(path) == {"a": 1e-3, "b": "no", "c": 10}


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("robots.0.route=[[4.8, 9]]", ["R1", "waypoint 1 (4.80, 9.00)", "outside"]),
        ("robots.0.route=[[0.02, 2]]", ["R1", "waypoint 1", "inside a wall"]),
        ("robots.0.start=[-1, -1, 0]", ["R1", "start", "outside"]),
        ("world.walls.1={points: [[3, 0.5], [3, 3.5]]}", ["R1", "way", "through a wall"]),
        ("drive.frame_interval_s=0.21", ["frame_interval_s is 0.21", "1/60"]),
    ],
)
def test_undrivable(
    tiny_path: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    override: str,
    words: list[str],
) -> None:
    path = tmp_path / "tiny.yaml"
    # two walls, so that the second can be replaced by one across the room
    far = "    - points: [[0, 0], [6, 0]]\n"
    path.write_text(TINY.replace("robots:\n", far + "robots:\n", 1), encoding="utf-8")
    arguments = ("--jobs", 1, "--set", override, "--results", tmp_path / "r")
    reply = command(capsys, "run", path, *arguments)
    assert reply.code == 2
    assert "Traceback" not in reply.err
    assert len(reply.complaints) == 1
    for word in ["scenario tiny", *words]:
        assert word in reply.complaints[0]


def test_error_in_a_worker_process_is_one_line(
    tiny_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = command(
        capsys,
        *("run", tiny_path, "--jobs", 2, "--set", "robots.0.start=[-1, -1, 0]"),
        *("--results", tmp_path),
    )
    assert reply.code == 2
    assert "Traceback" not in reply.err
    assert len(reply.complaints) == 1
    assert "outside" in reply.complaints[0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["frobnicate"], ["frobnicate"]),
        (["run"], ["SCENARIO"]),
        (["run", "nowhere.yaml"], ["nowhere.yaml", "no such file", "`mapfusion scenarios` lists"]),
        (["run", "x.yaml", "--bogus"], ["--bogus"]),
        (["run", "x.yaml", "--seed", "x"], ["--seed", "integer"]),
        (["run", "x.yaml", "--jobs", "0"], ["--jobs", "1"]),
        (["merge", "one.parquet", "-o", "f.parquet"], ["two maps"]),
        (["slam", "nowhere", "-o", "m.parquet"], ["nowhere", "frames.parquet"]),
        (["align", "a.parquet", "b.parquet"], ["a.parquet", "landmark_map"]),
        (["report", "nowhere", "--figures"], ["nowhere", "not a result folder"]),
    ],
)
def test_wrong_command(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(command(capsys, *arguments), *words)


@pytest.mark.parametrize("seeds", ["x", "1..", "3..1", "1,1", "", "-1", "1,,2", "0..4294967296"])
def test_wrong_seeds(tiny_path: Path, capsys: pytest.CaptureFixture[str], seeds: str) -> None:
    assert_refused(command(capsys, "check", tiny_path, "--seeds", seeds), f"--seeds {seeds}")


def test_wrong_section_of_a_single_stage(
    tiny_result: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = [tiny_result / "maps" / f"{name}.parquet" for name in ("R1", "R2")]
    reply = command(capsys, "align", *maps, "--set", "align.repetitions=x")
    assert_refused(reply, "align.repetitions", "integer")
    reply = command(capsys, "merge", *maps, "-o", "f.parquet", "--set", "merge.aligner=zz")
    assert_refused(reply, "merge.aligner", "zz", "ransac")


@pytest.mark.parametrize("damage", ["missing", "truncated", "foreign", "other table"])
@pytest.mark.parametrize("name", ["align", "merge", "slam", "report"])
def test_wrong_tables(
    tiny_result: Path,
    tiny_log: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: str,
    name: str,
) -> None:
    whole = tiny_result / "maps" / "R1.parquet"
    wrong, arguments = {
        "align": (tmp_path / "map.parquet", (whole, tmp_path / "map.parquet")),
        "merge": (tmp_path / "map.parquet", (whole, tmp_path / "map.parquet", "-o", "f.parquet")),
        "slam": (tmp_path / "observations.parquet", (tmp_path, "-o", tmp_path / "m.parquet")),
        "report": (tmp_path / "tables" / "landmarks.parquet", (tmp_path, "--figures", "--jobs", 1)),
    }[name]
    (tmp_path / "tables").mkdir()
    for table in sorted((tiny_result / "tables").glob("*.parquet")):
        (tmp_path / "tables" / table.name).write_bytes(table.read_bytes())
    for file in ("scenario.json", "world.json"):
        (tmp_path / file).write_bytes((tiny_result / file).read_bytes())
    (tmp_path / "frames.parquet").write_bytes((tiny_log / "frames.parquet").read_bytes())
    wrong.unlink(missing_ok=True)
    if damage == "truncated":
        wrong.write_bytes(whole.read_bytes()[:1000])
    elif damage == "foreign":
        pd.DataFrame({"a": [1]}).to_parquet(wrong)
    elif damage == "other table":
        wrong.write_bytes((tiny_log / "frames.parquet").read_bytes())
    reply = command(capsys, name, *arguments)
    assert reply.code == 2
    assert "Traceback" not in reply.err
    assert len(reply.complaints) == 1
    assert str(wrong) in reply.complaints[0]
    foreign = "kind is none" if name == "report" else "has no column"
    said = {"missing": "no such file", "truncated": "damaged", "foreign": foreign}
    assert said.get(damage, "kind is robot_log.frames, expected") in reply.complaints[0]


def test_figures_of_a_folder_that_is_no_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(command(capsys, "report", tmp_path, "--figures"), "not a result folder", "run")


def test_output_that_cannot_be_written(
    tiny_path: Path,
    tiny_results_copy: Path,
    tiny_log: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    blocked = tmp_path / "file" / "deep"
    blocked.parent.write_text("a file, not a folder")
    maps = [tiny_results_copy / "tiny-3" / "maps" / f"{name}.parquet" for name in ("R1", "R2")]
    check = ("check", tiny_path, "--jobs", 1, "--results", tiny_results_copy, "--seeds", 3)
    for arguments in (
        ("run", tiny_path, "--jobs", 1, "--results", blocked),
        ("record", tiny_path, "--jobs", 1, "--results", tiny_results_copy, "-o", blocked),
        ("slam", tiny_log, "-o", blocked / "m.parquet", "--set", "slam.filter.n_particles=2"),
        ("merge", *maps, "-o", blocked / "m.parquet"),
        ("merge", *maps, "-o", tmp_path),
        (*check, "--junit", blocked / "junit.xml"),
    ):
        reply = command(capsys, *arguments)
        assert reply.code == 2, arguments
        assert len(reply.complaints) == 1, arguments
        assert "cannot be" in reply.complaints[0]
        assert str(tmp_path) in reply.complaints[0]


def test_schema(capsys: pytest.CaptureFixture[str]) -> None:
    reply = command(capsys, "scenarios", "--schema")
    assert reply.code == 0
    schema = json.loads(reply.out)
    kinds = {option["$ref"].rpartition("/")[2]: option for option in schema["anyOf"]}
    assert set(kinds) == {"Simulation", "GeneratedScenario", "Recording"}
    required = {"Simulation": {"world", "robots", "drive"}, "Recording": {"logs"}}
    required["GeneratedScenario"] = {"generate", "drive"}
    for name, own in required.items():
        described = schema["$defs"][name]
        assert set(described["required"]) == {"schema_version", "name"} | own
        assert described["additionalProperties"] is False
    for reference in _references(schema):
        assert reference.removeprefix("#/$defs/") in schema["$defs"]
    for path in sorted(SCENARIOS.glob("*.yaml")):
        given = read_mapping(path)
        kind = "Recording" if "logs" in given else "Simulation"
        kind = "GeneratedScenario" if "generate" in given else kind
        assert set(given) <= set(schema["$defs"][kind]["properties"])
        load_scenario(path)


def _references(node: object) -> list[str]:
    if isinstance(node, dict):
        own = [node["$ref"]] if isinstance(node.get("$ref"), str) else []
        return own + [found for value in node.values() for found in _references(value)]
    return [f for value in node for f in _references(value)] if isinstance(node, list) else []
