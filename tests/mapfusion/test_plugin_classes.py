"""Classes of plug-ins by their targets."""

from pathlib import Path

import pytest

from mapfusion.plugin_classes import load_class, target_in_file


def test_a_class_of_a_module_may_be_nested() -> None:
    assert load_class("pathlib:Path") is Path
    assert load_class("pathlib:Path.home").__func__ is Path.home.__func__


def test_a_class_is_loaded_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("from pathlib import Path\n\nclass Mine:\n    number = 7\n")
    target = target_in_file(f"{file}:Mine", "an aligner")
    assert target == f"{file}:Mine"
    assert load_class(target).number == 7
    with pytest.raises(ValueError, match=r"mine\.py: has no class Mina; there: Mine; did you"):
        load_class(f"{file}:Mina")


def test_a_target_in_a_file_is_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.py").touch()
    monkeypatch.chdir(tmp_path)
    assert target_in_file("mine.py:Mine", "an aligner") == f"{tmp_path}/mine.py:Mine"
    assert target_in_file("mine:Mine", "an aligner") is None
    with pytest.raises(ValueError, match=r"other\.py: no such file .* of an aligner"):
        target_in_file("other.py:Mine", "an aligner")
