"""Environment variables that libraries read when they are imported do not end a command."""

import os
import subprocess
import sys

import pytest

from experiments.cli import main

IMPORTS = "import numexpr, pandas, numba, matplotlib.pyplot as p; print(p.get_backend())"


@pytest.mark.parametrize(
    ("name", "value", "taken"),
    [
        ("OMP_NUM_THREADS", "abc", "1"),
        ("OMP_NUM_THREADS", "0", "1"),
        ("OMP_NUM_THREADS", "-2", "1"),
        ("OMP_NUM_THREADS", "", "1"),
        ("OMP_NUM_THREADS", "9" * 5000, "1"),
        ("NUMBA_NUM_THREADS", "2.5", "1"),
        ("NUMEXPR_MAX_THREADS", "x", "1"),
        ("OMP_NUM_THREADS", "4,2", "4"),  # as OpenMP allows, for levels of nesting
        ("OMP_NUM_THREADS", "3", "3"),
    ],
)
def test_a_number_of_threads_is_one(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
    value: str,
    taken: str,
) -> None:
    monkeypatch.setenv(name, value)
    main._repair_thread_counts()
    assert os.environ[name] == taken
    warned = capsys.readouterr().err
    is_wrong = taken == "1" and value != ""
    assert ("is no number of threads; 1 is taken" in warned) == is_wrong
    assert len(warned.splitlines()) == is_wrong


def test_no_variable_is_set_that_was_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    main._repair_thread_counts()
    assert "OMP_NUM_THREADS" not in os.environ


def test_libraries_are_imported_under_a_damaged_environment() -> None:
    """The command itself, in a process of its own: it has to mend before anything is imported."""
    code = "import sys; sys.argv = ['mapfusion', '--version']\n"
    code += "from experiments.cli import main\n"
    code += f"try:\n    main.main()\nexcept SystemExit as e:\n    assert not e.code\n{IMPORTS}"
    wrong = {"OMP_NUM_THREADS": "abc", "NUMEXPR_MAX_THREADS": "x", "MPLBACKEND": "nope"}
    ended = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | wrong, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines()[-1].lower() == "agg"
