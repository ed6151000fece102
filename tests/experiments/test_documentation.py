"""The documentation site: its index, its reference, and its blocks of code."""

import importlib.util
import inspect
import json
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
import typer
from ruamel.yaml import YAML
from typer.main import get_command

import mapfusion
from experiments.cli.main import app
from experiments.evaluation import tables
from experiments.scenario.loading import load_scenario, setting_keys
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.datasets.camera_calibration import parse_lens
from mapfusion.fusion.fusers import GROUP as FUSER_GROUP
from mapfusion.fusion.fusers import make_fuser
from mapfusion.geometry import se2
from mapfusion.landmark_map import read_map
from tests.helpers.tiny_scenario import TINY, command

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(DOCS.glob("*.md"))
PAGE_IDS = [page.stem for page in PAGES]
# Command lines with placeholders in place of values cannot be parsed.
_PLACEHOLDER = re.compile(r"\bF\b|NAME|KEY=|\.\.\.|FILE|FOLDER|COMMAND|\[|<|\$|\bPAGE\b|\|")


def blocks(name: str, kind: str = "") -> list[str]:
    """Return the code blocks of one kind of a page."""
    text = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    found = re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [block for own, block in found if own == kind]


def command_lines(page: Path) -> Iterator[list[str]]:
    """Yield the arguments of each command of `mapfusion` in the blocks of a page."""
    for block in blocks(page.stem) + blocks(page.stem, "bash"):
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("mapfusion ") and not _PLACEHOLDER.search(line):
                yield shlex.split(line, comments=True)[1:]


@pytest.fixture(scope="module")
def site() -> ModuleType:
    """The configuration of the site, which writes the reference."""
    spec = importlib.util.spec_from_file_location("site_configuration", DOCS / "conf.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_index_lists_every_page() -> None:
    trees = re.findall(r"```{toctree}\n(.*?)```", (DOCS / "index.md").read_text(), re.DOTALL)
    listed = [line for tree in trees for line in tree.split() if not line.startswith(":")]
    own = {line for line in listed if (DOCS / f"{line}.md").is_file() and "/" not in line}
    assert own == {*PAGE_IDS} - {"index"}
    assert {"reference/api", "reference/command_line", "reference/scenario_keys"} <= {*listed}


@pytest.mark.parametrize("page", PAGES, ids=PAGE_IDS)
def test_links_to_pages_and_files_exist(page: Path) -> None:
    for link in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if not re.match(r"\w+:", link):
            assert (page.parent / link).exists() or link.startswith("reference/"), link


@pytest.mark.parametrize("page", PAGES, ids=PAGE_IDS)
def test_commands_and_options_of_the_pages_exist(page: Path) -> None:
    for words in command_lines(page):
        group, left = get_command(app), words
        context = typer.Context(group)
        while True:
            name, each, left = group.resolve_command(context, left)  # type: ignore[attr-defined]
            assert each is not None
            if not hasattr(each, "commands"):
                break
            group, context = each, typer.Context(each, parent=context)
        each.make_context(name, list(left), parent=context)


def test_every_scenario_key_has_a_type_and_a_meaning(site: ModuleType) -> None:
    keys = [*site.scenario_keys()]
    documented = {f"{key.section}.{key.name}".lstrip(".") for key in keys}
    assert {key for key in setting_keys() if key not in documented} == set()
    for key in keys:
        assert key.kind, key
        assert key.meaning.strip(), key
        assert key.kind != "any", key
        # a length or an angle says in which unit
        if re.search(r"_(m|rad|px|s)$", key.name) and key.kind in ("number", "integer"):
            assert re.search(r"\[.+\]$", key.meaning), key
    page = site.scenario_page()
    for key in documented:
        assert f"| `{key.rpartition('.')[2]}` |" in page


def test_every_command_is_in_the_reference(site: ModuleType) -> None:
    page = site.command_page()
    for words in ("run", "study leaderboard", "align", "import kitti"):
        assert f"## mapfusion {words}\n" in page
    assert "--set" in page


def test_every_table_and_column_is_on_the_page_of_formats() -> None:
    text = (DOCS / "formats.md").read_text(encoding="utf-8")
    for name, schema in tables.ALL.items():
        for field in schema:
            (row,) = re.findall(rf"^\| {name} \| `{field.name}` \|(.*)\|$", text, re.MULTILINE)
            kind, _, meaning = (cell.strip() for cell in row.split("|"))
            assert kind == str(field.type)
            assert meaning, (name, field.name)


def test_own_maps_are_aligned_and_merged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made, renamed, used = blocks("own_maps", "python")
    names: dict = {}
    exec(compile(made, "own_maps", "exec"), names)
    exec(compile(renamed, "own_maps", "exec"), names)
    assert set(names["table"]) == {"x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2"}
    for words in command_lines(DOCS / "own_maps.md"):
        reply = command(capsys, *words)
        assert reply.code == 0, reply.err
    for name in ("aligned.html", "fused.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    assert len(read_map(tmp_path / "fused.parquet")) == 40
    exec(compile(used, "own_maps", "exec"), names)
    np.testing.assert_allclose(names["found"].T_a_b, names["T_a_b"], atol=0.05)
    assert len(read_map(tmp_path / "fused.csv")) == 40


def test_the_own_aligner_finds_the_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks("own_maps", "python")[0], "own_maps", "exec"), {})
    (tmp_path / "mine.py").write_text(blocks("own_aligner", "python")[0])
    reply = command(capsys, "align", "a.parquet", "b.parquet", "--aligner", "mine.py:TrimmedFit")
    assert reply.code == 0, reply.err
    assert re.search(r"^TrimmedFit +accepted +1[12]\.\d+ +-[34]\.\d+ +0\.[45]", reply.out, re.M)


def test_the_own_recording_becomes_a_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(blocks("own_recording", "python")[0], "own_recording", "exec"), names)
    for words in command_lines(DOCS / "own_recording.md"):
        if not {"kitti", "north", "mine"} & set(re.split(r"\W", " ".join(words))):
            reply = command(capsys, *words)
            assert reply.code == 0, reply.err
    found = read_map(tmp_path / "yard.smoothed.parquet")
    points, true = found.position_m[:, :2], names["posts"][found.label]
    T_yard_map = np.array(fit_rigid(true, points, np.arange(len(found))))
    # the map's frame is the pose at the first measurement: one step from (0, -4)
    np.testing.assert_allclose(T_yard_map, [0.2, -4, 0.05], atol=0.03)
    off_m = np.linalg.norm(se2.transform_points(T_yard_map, points) - true, axis=1)
    assert np.median(off_m) < 0.02


def test_the_first_run_is_read_by_pandas(
    tiny_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "quick-0").symlink_to(tiny_result)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(blocks("first_run", "python")[0], "first_run", "exec"), names)
    assert isinstance(names["last"], pd.DataFrame)
    assert "oracle" in set(names["last"]["aligner"])


def test_the_gate_of_a_ci_is_a_valid_scenario(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    expect, steps = blocks("ci_gate", "yaml")
    path = tmp_path / "mine.yaml"
    path.write_text(TINY.partition("expect:")[0] + expect, encoding="utf-8")
    reply = command(capsys, "run", path, "--dry-run", "--results", tmp_path)
    assert reply.code == 0, reply.err
    assert [next(iter(step)) for step in YAML(typ="safe").load(steps)] == ["run", "run", "uses"]


def with_fragment(base: dict, fragment: dict) -> dict:
    """Return a scenario in which a page's block replaces values; lists and worlds as a whole."""
    merged = dict(base)
    for key, value in fragment.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict) and key != "world"
        merged[key] = with_fragment(base[key], value) if both else value
    return merged


@pytest.mark.parametrize("page", ["plugins", "refusal", "scenarios", "speed"])
def test_yaml_blocks_are_valid_scenarios(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    example = Path(__file__).parents[1] / "plugin_example" / "mapfusion_best_share.py"
    code = example.read_text(encoding="utf-8").replace("BestShare", "Nearest")
    (tmp_path / "mine.py").write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    yaml = YAML(typ="safe")
    for k, block in enumerate(blocks(page, "yaml")):
        # the page's package is not installed here
        fragment = yaml.load(block.replace("method: best_share", "method: mine.py:Nearest"))
        base = yaml.load(TINY)
        if "generate" in fragment:  # in place of the world and its robots
            base = {name: base[name] for name in ("schema_version", "name", "drive")}
        path = tmp_path / f"{page}_{k}.yaml"
        yaml.dump(with_fragment(base, fragment), path)
        load_scenario(path)


def test_maps_as_the_page_of_formats_makes_them_are_aligned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks("formats", "python")[0], "formats", "exec"), {})
    reply = command(capsys, "align", "north.parquet", "south.parquet", "--json")
    assert reply.code == 0, reply.err
    found = next(row for row in json.loads(reply.out)["aligners"] if row["aligner"] == "ransac")
    motion = found["refined"]
    expected = {"tx_m": 2.0, "ty_m": -1.0, "theta_rad": 0.4}
    assert {name: motion[name] for name in expected} == pytest.approx(expected, abs=0.03)


def test_classes_of_the_page_of_plug_ins_work(tmp_path: Path) -> None:
    of_aligner, of_descriptor = blocks("plugins", "python")
    example = Path(__file__).parents[1] / "plugin_example" / "mapfusion_best_share.py"
    assert of_aligner in example.read_text(encoding="utf-8")
    names: dict = {}
    exec(compile(of_descriptor, "plugins", "exec"), names)
    image = np.random.default_rng(0).integers(0, 256, (40, 60), dtype=np.uint8)
    described = names["Brightness"]().describe(image, np.array([[30.0, 20.0]]), np.ones(1))
    assert described.shape == (1, 16)
    assert described[0, 0] == image[20 - 8, 30 - 8]
    project = tomllib.loads(blocks("plugins", "toml")[0])
    assert project["project"]["entry-points"] == {
        "mapfusion.aligners": {"best_share": "mapfusion_best_share:BestShare"}
    }


def test_the_fuser_of_the_page_of_fusers_has_the_interface() -> None:
    names: dict = {}
    exec(compile(blocks("fusers", "python")[0], "fusers", "exec"), names)
    expected = inspect.signature(make_fuser("kalman").fuse)
    assert list(inspect.signature(names["Mine"]().fuse).parameters) == list(expected.parameters)
    project = tomllib.loads(blocks("fusers", "toml")[0])
    assert list(project["project"]["entry-points"]) == [FUSER_GROUP]


def test_the_page_of_recordings_reads_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_text(TINY, encoding="utf-8")
    arguments = ("--set", "drive.frames=3", "--results", "results")
    reply = command(capsys, "record", "tiny.yaml", "--format", "kitti", "-o", "k", *arguments)
    assert reply.code == 0, reply.err
    sequence = next(path.parent for path in (tmp_path / "k").rglob("calib.txt"))
    code = blocks("recordings", "python")[0].replace("dataset/sequences/00", str(sequence))
    names: dict = {"mapfusion": mapfusion, "Path": Path}
    exec(compile(code, "recordings", "exec"), names)
    assert names["left"].shape == names["right"].shape
    lens = parse_lens("page", YAML(typ="safe").load(blocks("recordings", "yaml")[0])["cam0"])
    assert lens.focal_px == (535.4, 539.2)


def test_the_page_of_statistics_reads_runs(
    tiny_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "quick-0").symlink_to(tiny_result)
    monkeypatch.chdir(tmp_path)
    names: dict = {"Path": Path}
    code = blocks("statistics", "python")[0].replace(', Path("results/quick-1")', "")  # one run
    exec(compile(code, "statistics", "exec"), names)
    assert "oracle" in set(names["errors"]["aligner"])
