"""Commands and their options: few, in the order of a day, and of one meaning each."""

from pathlib import Path

import click
import pytest
import typer
from typer.main import get_command

from experiments.cli.main import app
from experiments.scenario.loading import OWN
from tests.helpers.tiny_scenario import assert_refused, command

MAPS = ("a.parquet", "b.parquet")


def all_commands() -> dict[str, click.Command]:
    """Every command by its words."""
    top = get_command(app).commands  # type: ignore[attr-defined]
    below = {f"{a} {b}": c for a in top for b, c in getattr(top[a], "commands", {}).items()}
    return {name: each for name, each in (top | below).items() if not hasattr(each, "commands")}


def test_at_most_fifteen_commands_in_panels_in_the_order_of_a_day(
    capsys: pytest.CaptureFixture[str],
) -> None:
    top = get_command(app).commands  # type: ignore[attr-defined]
    assert len(top) <= 15
    shown = command(capsys, "--help").out
    panels = ["Run", "Look and compare", "Your own maps, logs and recordings"]
    places = [shown.index(f"─ {panel} ─") for panel in panels]
    assert places == sorted(places)
    assert "─ Commands ─" not in shown


def test_an_option_means_the_same_everywhere() -> None:
    helps: dict[str, set[str]] = {}
    for name, each in all_commands().items():
        for parameter in each.params:
            if isinstance(parameter, typer.core.TyperOption) and name != "sweep":
                helps.setdefault(parameter.opts[0], set()).add(parameter.help or "")
    # what is written differs, that it is written does not; pairs are counted in both
    assert {name for name, texts in helps.items() if len(texts) > 1} <= {"--output", "--pairs"}
    for name in ("run", "check", "sweep"):
        options = {option for each in all_commands()[name].params for option in each.opts}
        assert {"--results", "--set", "--jobs", "--output", "-o"} <= options
        assert options & {"--seed", "--seeds"}


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("align", *MAPS, "--set", "repetitions=3"), "align.repetitions"),
        (("align", *MAPS, "--set", "aligners.0.name=x"), "align.aligners.0.name"),
        (
            ("slam", "log", "-o", "m.parquet", "--set", "filter.n_particles=3"),
            "slam.filter.n_particles",
        ),
        (("merge", *MAPS, "-o", "m.parquet", "--set", "aligner=svd"), "merge.aligner"),
        (("run", "quick", "--set", "n_particles=3"), "slam.filter.n_particles"),
    ],
)
def test_keys_begin_at_the_root(
    arguments: tuple[str, ...], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    key = arguments[-1].partition("=")[0]
    assert_refused(command(capsys, *arguments), f"--set {key}: keys begin", f"root: {meant}\n")


@pytest.mark.parametrize("arguments", [("record",), ("align", *MAPS, "--scenario")])
def test_a_suite_name_is_taken_wherever_a_scenario_is(
    arguments: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert OWN.is_dir()
    wrong = ("--set", "slam.bogus=1", *(("-o", tmp_path / "x") if arguments == ("record",) else ()))
    assert_refused(command(capsys, *arguments, "quick", *wrong), "quick.yaml", "slam.bogus")
    assert_refused(command(capsys, *arguments, "full", *wrong), "full", "stands for 5 scenarios")
    assert_refused(command(capsys, *arguments, "nowhere", *wrong), "nowhere", "neither a file")


def test_one_folder_for_several_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reply = command(capsys, "run", "full", "-o", tmp_path / "x")
    assert_refused(reply, "--output", "5 runs", "--results")
