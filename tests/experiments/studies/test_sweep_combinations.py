"""Scenarios x seeds x values."""

import pickle
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.scenario.yaml_files import apply_overrides
from experiments.studies.sweep import parse_axes, runs_of
from mapfusion.errors import InputError
from tests.helpers.tiny_scenario import TINY


@pytest.mark.parametrize(
    ("entry", "given", "spelled"),
    [
        ("a.b=50,200,1000", [50, 200, 1000], ("50", "200", "1000")),
        ("a=1e-3, 0.10", [0.001, 0.1], ("0.001", "0.1")),
        ("a=[1, 2],[3]", [[1, 2], [3]], ("[1, 2]", "[3]")),
        ("a={x: 1, y: [2, 3]},{}", [{"x": 1, "y": [2, 3]}, {}], ('{"x": 1, "y": [2, 3]}', "{}")),
        ("a=true,yes,'true'", [True, "yes", "true"], ("true", "yes", '"true"')),
        ('a="b,c",d', ["b,c", "d"], ("b,c", "d")),
        ("a=motion", ["motion"], ("motion",)),
        ("a=b=c,null", ["b=c", None], ("b=c", "null")),
        ("a=../logs/R1,x-1.5", ["../logs/R1", "x-1.5"], ("../logs/R1", "x-1.5")),
    ],
)
def test_values_are_parted_at_commas_outside_brackets(
    entry: str, given: list[object], spelled: tuple[str, ...]
) -> None:
    (values,) = parse_axes([entry]).values()
    assert values == spelled
    read = [apply_overrides({}, [f"key={value}"])["key"] for value in values]
    assert read == given
    assert list(map(type, read)) == list(map(type, given))


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        (["a"], ["--set a", "key=value"]),
        (["=1"], ["--set =1", "key=value"]),
        (["a=1,,2"], ["--set a=1,,2", "key=value"]),
        (["a="], ["--set a=", "key=value"]),
        (["a=[1"], ["--set a=[1", "not plain YAML"]),
        (["a=1", "a=2"], ["--set a", "given twice", "a=A,B"]),
        (["a=0.1,0.10"], ["0.1", "given twice"]),
        (["seed=1,2"], ["seed", "--seeds"]),
        (["name=x"], ["name"]),
    ],
)
def test_wrong_entries_are_told(entries: list[str], words: list[str]) -> None:
    with pytest.raises(InputError) as error:
        parse_axes(entries)
    for word in words:
        assert word in str(error.value)


@given(
    st.lists(
        st.lists(st.integers(1 - 2**63, 2**63 - 1), min_size=1, max_size=3), min_size=1, max_size=4
    )
)
def test_lists_go_through_whole(lists: list[list[int]]) -> None:
    distinct = [list(values) for values in dict.fromkeys(map(tuple, lists))]
    axes = parse_axes([f"a={','.join(map(str, distinct))}"])
    assert axes["a"] == tuple(map(str, distinct))


def scenario(folder: Path, name: str) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(TINY.replace("name: tiny", f"name: {name}"), encoding="utf-8")
    return path


def test_all_combinations_with_names_of_their_own(tmp_path: Path) -> None:
    paths = [scenario(tmp_path, name) for name in ("one", "two")]
    axes = parse_axes(["slam.filter.n_particles=10,20,30", "align.repetitions=1,2"])
    runs = runs_of(paths, [0, 1, 5], axes)
    assert len(runs) == 2 * 3 * 3 * 2
    assert len({run.run_id for run in runs}) == len(runs)
    values = [tuple(value for _, value in run.settings) for run in runs]
    assert values[:3] == [("10", "1"), ("10", "2"), ("20", "1")]
    loaded = runs[4].load()
    assert (loaded.name, loaded.seed) == ("one", 0)
    assert (loaded.slam.filter.n_particles, loaded.align.repetitions) == (30, 1)
    assert (runs[-1].scenario, runs[-1].seed, values[-1]) == ("two", 5, ("30", "2"))


def test_a_file_that_is_edited_after_the_sweep_began_changes_no_run(tmp_path: Path) -> None:
    path = scenario(tmp_path, "one")
    axes = parse_axes(["slam.min_count=2,3"])
    runs = runs_of([path], [0, 1], axes)
    before = [run.load() for run in runs]
    path.write_text("name: another\n", encoding="utf-8")
    assert [run.load() for run in runs] == before
    path.unlink()
    assert [pickle.loads(pickle.dumps(run)).load() for run in runs] == before
    assert len({id(run.content) for run in runs}) == 1  # one for ten thousand runs


def test_names_do_not_depend_on_the_rest_of_the_sweep(tmp_path: Path) -> None:
    path = scenario(tmp_path, "one")
    assert runs_of([path], [7], {})[0].run_id == "one-7"
    few = runs_of([path], [7], parse_axes(["slam.min_count=2", "evaluate.every=5"]))
    more = runs_of([path], [6, 7], parse_axes(["evaluate.every=10,5", "slam.min_count=3,2"]))
    assert few[0].run_id in {run.run_id for run in more}


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (
            "slam.particles=5",
            ["slam.particles", "unknown key", "did you mean slam.filter.n_particles?"],
        ),
        ("slam.filter.particles=5", ["slam.filter.particles", "n_particles"]),
        ("slam.filter.n_particles=5,few", ["n_particles", "'few'"]),
    ],
)
def test_wrong_keys_and_values_are_told_before_anything_runs(
    tmp_path: Path, entry: str, words: list[str]
) -> None:
    with pytest.raises(InputError) as error:
        runs_of([scenario(tmp_path, "one")], [0], parse_axes([entry]))
    for word in words:
        assert word in str(error.value)


def test_two_scenarios_of_one_name_are_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(scenario(tmp_path, "one").read_text())
    with pytest.raises(InputError, match=r"other\.yaml: is named one, as .*one\.yaml"):
        runs_of([tmp_path / "one.yaml", other], [0], {})


def test_chosen_aligners_are_those_of_all_runs_and_values_apply_to_them(tmp_path: Path) -> None:
    path = scenario(tmp_path, "one")
    axes = parse_axes(["align.aligners.1.parameters.translation=printed,solved"])
    runs = runs_of([path], [0, 1], axes, ["gnc", "svd"])
    for run in runs:
        loaded = run.load().align.aligners
        assert [entry.name for entry in loaded] == ["gnc", "svd"]
        assert loaded[1].parameters == {"translation": run.settings[0][1]}
    listed = parse_axes(["align.aligners=[{name: icp, method: icp}]"])
    with pytest.raises(InputError, match=r"--aligner: --set align\.aligners gives aligners, too"):
        runs_of([path], [0], listed, ["gnc"])
    with pytest.raises(InputError, match="--aligner magic: unknown aligner"):
        runs_of([path], [0], {}, ["magic"])
