"""Every way to write an import is followed; other people's modules are not."""

from pathlib import Path

import pytest

from experiments.run import code_version

FILES = {
    "ours/__init__.py": "",
    "ours/start.py": "import numpy\nfrom ours import by_package, nested\n",
    "ours/by_package.py": "def late():\n    import ours.by_name\n",
    "ours/by_name.py": "from ours.by_module import number as renamed\n",
    "ours/nested.py": """
class Late:
    with open(__file__):
        for _ in ():
            pass
        else:
            try:
                pass
            except OSError:
                if True:
                    import ours.by_handler
    match 1:
        case 1:
            import ours.by_case
""",
    "ours/by_handler.py": "",
    "ours/by_case.py": "",
    "ours/by_module.py": "from ours import start  # a circle\nnumber = 1\n",
    "ours/unused.py": "",
    "ours/robot.urdf": "",
}


def test_every_import_of_ours_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "numpy.py").write_text("")  # beside ours, as where packages are installed
    monkeypatch.setattr(code_version, "SOURCE_ROOT", tmp_path)
    monkeypatch.setattr(code_version, "PACKAGES", ("ours",))
    code_version.imported_sources.cache_clear()
    found = code_version.imported_sources("ours.start")
    assert set(found) == set(FILES) - {"ours/unused.py", "ours/__init__.py"}
    deep = tmp_path / "ours" / "kit" / "within" / "deep.py"
    deep.parent.mkdir(parents=True)
    deep.write_text("from ours import unused\n")
    (tmp_path / "ours" / "kit" / "__init__.py").touch()
    whole = {"ours/kit/__init__.py", "ours/kit/within/deep.py", "ours/unused.py", "ours/robot.urdf"}
    assert set(code_version.imported_sources("ours.kit")) == whole


@pytest.mark.parametrize(
    ("file", "matters"),
    [
        ("ours/a.py", True),
        ("ours/new.py", True),
        ("ours/within/deep/er.py", True),
        ("ours/robot.urdf", True),
        ("single.py", True),
        ("ours/notes.txt", False),
        ("other.py", False),
    ],
)
def test_the_hash_is_of_all_source_and_of_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, matters: bool
) -> None:
    monkeypatch.setattr(code_version, "SOURCE_ROOT", tmp_path)
    (tmp_path / "ours").mkdir()
    for name in ("ours/a.py", "ours/robot.urdf", "ours/notes.txt", "single.py"):
        (tmp_path / name).write_text("1")

    def found() -> str:
        code_version.source_hash.cache_clear()
        return code_version.source_hash(("ours", "single.py"))

    before = found()
    assert found() == before
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text("2")
    changed = found()
    assert (changed != before) == matters
    if matters and file != "single.py":
        (tmp_path / file).rename(tmp_path / "ours" / f"moved{Path(file).suffix}")
        assert found() not in (before, changed)
    code_version.source_hash.cache_clear()
