"""Every way to write an import is followed; other people's modules are not."""

from pathlib import Path

import pytest

from experiments.run import sources

FILES = {
    "ours/__init__.py": "",
    "ours/start.py": "import numpy\nfrom ours import by_package\n",
    "ours/by_package.py": "def late():\n    import ours.by_name\n",
    "ours/by_name.py": "from ours.by_module import number as renamed\n",
    "ours/by_module.py": "from ours import start  # a circle\nnumber = 1\n",
    "ours/unused.py": "",
}


def test_every_import_of_ours_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(sources, "SOURCE_ROOT", tmp_path)
    found = sources.imported_sources("ours.start")
    assert set(found) == set(FILES) - {"ours/unused.py"}
