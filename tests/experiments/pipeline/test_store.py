from collections import Counter
from pathlib import Path

import pytest

from experiments.pipeline.stage import Job, Stage
from experiments.pipeline.store import Store, link_or_copy, require_undamaged
from experiments.pipeline.tasks import tasks_of
from mapfusion.errors import DamagedFileError, StoreRepairWarning
from mapfusion.files import write_json


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
    assert folder.quantities()["extra_s"] == 4.0
    assert folder.quantities()["elapsed_s"] > 0
    (folder.path / "half_a").unlink()  # what a part wrote counts, not its mark alone
    assert not folder.finished
    assert [task.finished for task in tasks.values()] == [False, True]
    folder.discard()
    assert not folder.finished
    assert not folder.path.exists()
    folder.discard()


def finished_stage(root: Path) -> tuple[Path, dict[str, Path]]:
    """The folder of a stage of two parts, each with a file of its own and one beside it."""
    stage = Stage("slam", "FastSLAM", 1, work, ("half_{part}",), parts=("a", "b"))
    folder = Store(root).folder(stage)
    folder.path.mkdir(parents=True)
    for part, (half, _) in folder.outputs.items():
        half.write_bytes(b"half " + part.encode())
        (folder.path / f"picture_{part}.png").write_bytes(b"picture " + part.encode())
        (folder.path / ".half.part").write_bytes(b"of another process")
        folder.finish(part, {"elapsed_s": 1.5})
    (folder.path / ".half.part").unlink()
    return folder.path, {path.name: path for path in folder.path.iterdir()}


def test_a_flipped_bit_of_a_finished_stage_is_noticed(tmp_path: Path) -> None:
    folder, files = finished_stage(tmp_path)
    require_undamaged(folder)
    assert len(files) == 6
    for path in files.values():
        data = path.read_bytes()
        for at in range(0, len(data), 5):
            flipped = bytearray(data)
            flipped[at] ^= 1 << at % 8
            path.write_bytes(flipped)
            with pytest.raises(DamagedFileError) as raised:
                require_undamaged(folder)
            assert raised.value.path == path
        path.write_bytes(data)
        require_undamaged(folder)


@pytest.mark.parametrize("data", [None, b"", b"half", b"half a!"])
def test_a_file_of_a_stage_that_is_missing_or_cut_is_named(
    tmp_path: Path, data: bytes | None
) -> None:
    folder, files = finished_stage(tmp_path)
    half = files["half_a"]
    half.unlink() if data is None else half.write_bytes(data)
    with pytest.raises(DamagedFileError, match=r"half_a: (damaged|no such file)"):
        require_undamaged(folder)
    require_undamaged(folder, "picture_*.png")


def test_what_is_added_to_a_finished_stage_later_is_not_checked(tmp_path: Path) -> None:
    folder, _ = finished_stage(tmp_path)
    (folder / "aligner_timings.parquet").write_bytes(b"")
    require_undamaged(folder)
    require_undamaged(tmp_path / "log of a user")


@pytest.mark.parametrize("files", [None, [], {"half_a": 3}, {"half_a": {"size": -1}}])
def test_a_mark_that_lists_no_files_is_named(tmp_path: Path, files: object) -> None:
    folder, paths = finished_stage(tmp_path)
    write_json(paths["done_a.json"], {"figures": {}, "files": files})
    with pytest.raises(DamagedFileError, match=r"done_a\.json: is not the mark of a finished"):
        require_undamaged(folder)


def test_a_stage_is_made_from_sound_inputs_alone(tmp_path: Path) -> None:
    store = Store(tmp_path)
    first = Stage("drive", "drive", 1, work, ("half_",))
    second = Stage("slam", "FastSLAM", 1, work, ("half_",), {"drive": first})
    tasks = tasks_of([first, second], store)
    for stage in (first, second):
        store.path(stage).mkdir(parents=True)
    one, two = tasks.values()
    one.run()
    damaged = store.path(first) / "half_"
    damaged.write_text("2")
    with pytest.raises(DamagedFileError) as raised:
        two.run()
    assert raised.value.path == damaged
    mended = Counter[Path]()
    with pytest.warns(StoreRepairWarning, match="the stage drive is discarded"):
        assert store.discard_damaged(raised.value, mended)
    assert not damaged.exists()
    store.path(first).mkdir(parents=True)
    one.run()
    assert store.discard_damaged(raised.value, mended)  # told late: it is sound again
    assert damaged.exists()
    two.run()


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
