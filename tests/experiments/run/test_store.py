from pathlib import Path

import pytest

from experiments.run.store import Store, link_or_copy


def test_a_stage_is_finished_once_it_says_so(tmp_path: Path) -> None:
    folder = Store(tmp_path).stage("slam", {"a": 1}, [], ())
    assert folder.path == tmp_path / "slam" / folder.key
    assert not folder.finished
    folder.path.mkdir(parents=True)
    (folder.path / "half.parquet").write_text("")
    assert not folder.finished
    folder.finish(elapsed_s=1.5)
    assert folder.finished
    assert folder.figures()["elapsed_s"] == 1.5
    folder.discard()
    assert not folder.finished
    assert not folder.path.exists()
    folder.discard()


def test_settings_in_another_order_are_the_same(tmp_path: Path) -> None:
    store = Store(tmp_path)
    one, other = ({"a": 1, "b": [1, 2]}, {"b": [1, 2], "a": 1})
    assert store.stage("s", one, [], ()).key == store.stage("s", other, [], ()).key
    assert store.stage("s", {"b": [2, 1], "a": 1}, [], ()).key != store.stage("s", one, [], ()).key
    assert store.stage("t", one, [], ()).key != store.stage("s", one, [], ()).key


def test_links_share_what_they_can_and_replace_what_was_there(tmp_path: Path) -> None:
    source, target = tmp_path / "source", tmp_path / "deep" / "target"
    source.write_text("new")
    link_or_copy(source, target)
    assert target.samefile(source)
    link_or_copy(source, target)
    other = tmp_path / "other"
    other.write_text("old")
    link_or_copy(source, other)
    assert other.read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deep", "other", "source"]


def test_copies_where_no_link_can_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, target: Path) -> None:
        raise OSError("another file system")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    source, target = tmp_path / "source", tmp_path / "target"
    source.write_text("new")
    link_or_copy(source, target)
    assert target.read_text() == "new"
    assert not target.samefile(source)


def test_a_failed_copy_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "target"
    target.write_text("old")
    with pytest.raises(FileNotFoundError):
        link_or_copy(tmp_path / "nowhere", target)
    assert target.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["target"]
