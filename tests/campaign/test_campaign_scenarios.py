"""A sample of the broken scenarios; `python -m tests.campaign` tries all."""

import random
from pathlib import Path

import pytest

from experiments.evaluation.metrics import load_checked
from experiments.scenario.settings import AnyScenario
from mapfusion.errors import MOST_CHARACTERS, InputError
from tests.campaign.mutated_scenarios import DRAWN, bomb, complaint, explore
from tests.helpers.tiny_scenario import TINY


def test_each_of_250_mutants_is_a_scenario_or_one_line(tmp_path: Path) -> None:
    seen, faults = explore(seed="7", count=250, runs=0, folder=tmp_path)
    assert not faults
    assert min(seen["valid"], seen["refused"]) > 15  # both were tried


ALIASES = [f"a{i}: &a{i} [" + ", ".join([f"*a{i - 1}"] * 10) + "]" for i in range(1, 11)]
MERGES = [line.replace("[", "{<<: [").replace("]", "]}") for line in ALIASES]
CHAIN = [f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 99)]
LOGS = "schema_version: 1\nname: x\nlogs: [{}]\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (DRAWN + "seed: -1\n", "seed: is -1, must be in [0, 4294967295]"),
        (DRAWN + "seed: [1]\n", "seed: is [1], expected an integer"),
        (TINY.replace("name: R1", "name: fused"), "robots.0.name: the name fused is taken"),
        (TINY.replace("name: R1", "name: oracle"), "robots.0.name: the name oracle is taken"),
        (TINY.replace("  path_rmse_m:", "  1:"), "expect: the key 1 is no text"),
        (
            TINY.replace("path_rmse_m", "path_rmse"),
            "did you mean path_rmse_m?",
        ),
        (TINY.replace("n_particles", "n_particle"), "did you mean n_particles?"),
        (TINY.replace("method: icp", "method: icq"), "did you mean icp"),
        (TINY.replace("ransac}", "ransac, parameters: {name: x}}"), "name: unknown; known: gate_m"),
        (TINY.replace("ransac}", "ransac, parameters: {self: x}}"), "self: unknown; known: gate_m"),
        (TINY.replace("ransac}", "ransac, parameters: {gate_m: x}}"), "parameters.gate_m: is 'x'"),
        (
            TINY.replace("ransac}", "ransac, parameters: {gate_m: -1}}"),
            "must be in [0.001, 1000] m",
        ),
        (TINY.replace("ransac}", "ransac, parameters: {height: 1}}"), "height: expected probabi"),
        ("\n".join(["a0: &a0 {x: 1}", *ALIASES]), "holds more than 200000 values"),
        ("\n".join(["a0: &a0 {x: 1}", *MERGES]), "holds more than 200000 values"),
        (
            "\n".join(f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 99)).replace("*a0", "0"),
            "too deep",
        ),
        ("a: &a [*a]", "holds itself"),
        (TINY + 'x: !!int ""\n', "not plain YAML"),
        (TINY.replace("seed: 3", "seed: " + "9" * 5000), "5000 digits"),
        (TINY.replace("seed: 3", "seed: " + "9" * 4000), "seed: an integer of 13288 bits"),
        (LOGS.format('"a\\0b"'), "logs.0: 'a\\x00b' holds a character"),
        (LOGS.format("loop"), "logs: loop: no folder has this path"),
        (LOGS.format("a" * 5000), "no folder has this path (File name too long)"),
        (LOGS.format("/".join(["a" * 200] * 20)), "no folder has this path (File name too long)"),
        (TINY + 'description: "\\ud800"\n', "description: '\\ud800' holds a character"),
        (TINY + "x: 2001-01-01\n", "x: 2001-01-01 is a date; put it in quotes"),
        (TINY + "? [1, 2]\n: 3\n", "is no text; put it in quotes"),
        (TINY.replace("n_particles: 30", "n_particles: 1e9"), "[1, 10000] particles"),
        (
            TINY.replace("n_particles: 30", "n_particles: 30, descriptor_threshold: 1e-320"),
            "[0.001, 2]",
        ),
        (TINY.replace("focal_px: 144.25", "focal_px: 1e308"), "camera.focal_px: is 1e+308"),
        ("#" * 4_000_001, "larger than 4 MB"),
    ],
)
def test_what_once_got_past_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "loop").symlink_to("loop")
    path = tmp_path / "wrong.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as told:
        load_checked(path)
    line = str(told.value)
    assert said in line
    assert "wrong.yaml" in line
    assert len(line) <= MOST_CHARACTERS
    assert line.isprintable()


def test_bombs_are_told_at_once(tmp_path: Path) -> None:
    rng, path = random.Random(1), tmp_path / "bomb.yaml"
    for _ in range(10):
        path.write_text(bomb(rng), encoding="utf-8")
        fault, scenario = complaint(lambda: load_checked(path))
        assert not fault
        assert scenario is None


def test_the_campaign_sees_what_is_wrong() -> None:
    def raises(error: Exception) -> AnyScenario:
        raise error

    assert complaint(lambda: raises(KeyError("x")))[0].startswith("KeyError")
    assert not complaint(lambda: raises(InputError("x\n\x1b" * 400)))[0]  # cut by construction
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(InputError, "__str__", lambda error: "x" * (MOST_CHARACTERS + 1))
        assert "not a line" in complaint(lambda: raises(InputError("")))[0]
