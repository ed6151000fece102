from pathlib import Path

import pytest

from experiments.pipeline.stage import Job, Stage
from experiments.pipeline.store import Store, link_or_copy
from experiments.pipeline.tasks import tasks_of
from mapfusion.errors import DamagedFileError


def work(settings: int, job: Job) -> dict[str, float]:
    (job.output / f"half_{job.part}").write_text(str(settings))
    return {"extra_s": 2.0}


work.__module__ = "experiments.pipeline.stage"  # a key covers the source of the harness alone


def test_a_stage_is_finished_once_all_its_parts_are(tmp_path: Path) -> None:
    store = Store(tmp_path)
    stage = Stage("slam", "FastSLAM", 1, work, ("half_{part}",), parts=("a", "b"))
    folder = store.folder(stage)
    assert folder.path == tmp_path / "slam" / stage.key
    assert not folder.finished
    folder.path.mkdir(parents=True)
    tasks = tasks_of([stage], store)
    for done, task in enumerate(tasks.values()):
        assert folder.finished == (done == 2)
        task.run()
    assert folder.finished
    assert folder.figures()["extra_s"] == 4.0
    assert folder.figures()["elapsed_s"] > 0
    (folder.path / "half_a").unlink()  # what a part wrote counts, not its mark alone
    assert not folder.finished
    assert [task.finished for task in tasks.values()] == [False, True]
    folder.discard()
    assert not folder.finished
    assert not folder.path.exists()
    folder.discard()


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
    with pytest.raises(DamagedFileError):
        link_or_copy(tmp_path / "nowhere", target)
    assert target.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["target"]
