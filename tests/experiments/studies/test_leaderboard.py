"""The frozen task set, and the ranking of aligners and fusers on it."""

import hashlib
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.evaluation.result import run_scenario
from experiments.pipeline.stage import imported_sources
from experiments.pipeline.store import Store
from experiments.pipeline.tables import read_rows, write_rows
from experiments.pipeline.workers import single_threaded
from experiments.scenario.loading import load_scenario
from experiments.studies import leaderboard
from experiments.studies.leaderboard import (
    chosen_methods,
    rank_aligners,
    rank_fusers,
    read_estimates,
    run_leaderboard,
)
from experiments.studies.task_set import (
    CARD,
    OFFERED,
    TaskSet,
    make_task_set,
    tasks_of_scenario,
)
from mapfusion.errors import InputError
from mapfusion.geometry import se2
from tests.helpers.shared_folder import shared_folder
from tests.helpers.tiny_scenario import TINY, TRIO, assert_refused, command

SEEDS = (3,)
MOTION = ["tx_m", "ty_m", "theta_rad"]


def quiet(label: str, done: int, total: int) -> None:
    """No progress."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a scenario, its store and its task set `tasks`; tests must not change it."""

    def make(folder: Path) -> None:
        single_threaded()
        (folder / "trio.yaml").write_text(TRIO, encoding="utf-8")
        make_task_set(
            folder / "tasks", [str(folder / "trio.yaml")], SEEDS, Store.of(folder), 1, quiet
        )

    return shared_folder(tmp_path_factory, "leaderboard", make)


@pytest.fixture(scope="module")
def task_set(made: Path) -> TaskSet:
    """The task set."""
    return TaskSet.read(made / "tasks")


def truth_table(task_set: TaskSet) -> pd.DataFrame:
    """True motions of all tasks, as a file of estimates."""
    rows = []
    for scenario in task_set.scenarios:
        for task in tasks_of_scenario(task_set.folder, task_set.digest, scenario):
            T = se2.between(task.pair.a.path.T_world_map, task.pair.b.path.T_world_map)
            rows.append({"task": task.name, **dict(zip(MOTION, T, strict=True))})
    return pd.DataFrame(rows)


def test_the_same_command_gives_the_same_bytes(made: Path, task_set: TaskSet) -> None:
    again = made / "again"
    store = Store.of(made)
    found = make_task_set(again, [str(made / "trio.yaml")], SEEDS, store, 1, quiet)
    files = {path.relative_to(again) for path in again.rglob("*") if path.is_file()}
    assert found.digest == task_set.digest
    assert files == {p.relative_to(task_set.folder) for p in task_set.folder.rglob("*.*")}
    for file in files:
        assert (again / file).read_bytes() == (task_set.folder / file).read_bytes(), file


def test_there_is_a_task_for_each_pair_in_the_middle_and_at_the_end(task_set: TaskSet) -> None:
    rows = task_set.tasks
    assert len(rows) == rows["task"].nunique() == 6
    assert rows["iteration"].nunique() == 2
    for row in rows.to_dict("records"):
        assert row["robot_a"] < row["robot_b"]


def test_what_methods_get_says_nothing_of_the_truth(task_set: TaskSet) -> None:
    outside = [path for path in task_set.folder.rglob("*.parquet") if path.parent.name != "truth"]
    columns = {name for path in outside for name in pd.read_parquet(path).columns}
    assert not {name for name in columns if "truth" in name or "true" in name}
    assert len([*(task_set.folder / "truth").iterdir()]) == 2


def test_errors_are_those_of_the_run(made: Path, task_set: TaskSet, tmp_path: Path) -> None:
    """The evaluation of a run and the leaderboard read the same maps by different ways."""
    scenario = load_scenario(made / "trio.yaml", ["render.renderer=raycast"])
    run_scenario(scenario, made, 1, quiet, output=tmp_path / "result")
    table = tables.read(
        tables.table_path(tmp_path / "result", "smoothed_errors"), "smoothed_errors"
    )
    board = run_leaderboard(
        task_set, chosen_methods(["ransac"], True)[0], (), (), Store.of(made), quiet
    )
    keys = ["robot_a", "robot_b", "iteration"]
    of_run, own = (rows[rows["aligner"] == "oracle"] for rows in (table, board.alignments))
    both = of_run.merge(own, on=keys, suffixes=("_run", ""))
    last = both["iteration"] == both["iteration"].max()
    assert len(both) == 6
    assert both["n_true"].max() >= 3
    for name in ("translation_error_m", "rotation_error_rad", "n_true", "n_common"):
        assert both[name].tolist() == pytest.approx(both[f"{name}_run"].tolist(), nan_ok=True)
    # joint covariances are kept for the last maps only
    known = both[last & both["alignment_nees_run"].notna()]
    assert len(known)
    ratio = known["alignment_nees"] / known["alignment_nees_run"]
    assert ratio.tolist() == pytest.approx([1] * len(known), rel=1e-3)  # stored in single precision


@pytest.mark.parametrize("damage", ["changed", "missing", "outside", "version", "no card"])
def test_a_changed_set_is_refused(task_set: TaskSet, tmp_path: Path, damage: str) -> None:
    folder = Path(shutil.copytree(task_set.folder, tmp_path / "tasks"))
    card = json.loads((folder / CARD).read_text())
    if damage == "changed":
        path = folder / "truth" / "points.parquet"
        path.write_bytes(path.read_bytes() + b" ")
    if damage == "missing":
        next((folder / "maps").iterdir()).unlink()
    if damage == "outside":
        card["distribution"][0]["contentUrl"] = "../secret"
    if damage == "version":
        card["version"] = "99"
    (folder / CARD).write_text("[]" if damage == "no card" else json.dumps(card))
    with pytest.raises(InputError, match=str(folder)):
        TaskSet.read(folder)


def test_true_motions_from_a_file_have_no_error(task_set: TaskSet, tmp_path: Path) -> None:
    truth_table(task_set).to_csv(tmp_path / "mine.csv", index=False)
    rows = read_estimates(tmp_path / "mine.csv", task_set)
    assert set(rows["aligner"]) == {"mine"}
    assert len(rows) == 6
    assert rows["translation_error_m"].max() < 1e-9
    assert rows["accepted"].all()


def test_covariances_and_verdicts_from_a_file_are_judged(task_set: TaskSet, tmp_path: Path) -> None:
    table = truth_table(task_set).iloc[1:]
    table["tx_m"] += 0.3
    covariance = {"cov_xx": 0.09, "cov_xy": 0, "cov_xt": 0, "cov_yy": 1, "cov_yt": 0, "cov_tt": 1}
    table = table.assign(**covariance, accepted=[0] + [1] * (len(table) - 1))
    table.to_csv(tmp_path / "mine.csv", index=False)
    rows = read_estimates(tmp_path / "mine.csv", task_set)
    assert rows["alignment_nees"].tolist()[1:] == pytest.approx([1] * 5)  # (0.3 / 0.3)^2
    assert rows["accepted"].tolist() == [False, False, True, True, True, True]
    assert np.isnan(rows["translation_error_m"].iloc[0])


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"drop": "tx_m"}, "has no column tx_m"),
        ({"task": "nowhere"}, "nowhere"),
        ({"twice": True}, "two rows"),
        ({"text": True}, "ty_m"),
        ({"accepted": np.nan}, "accepted: is not 0 or 1"),
        ({"accepted": 2}, "accepted: is not 0 or 1"),
        ({"cov_xx": 1.0}, "has no column cov_xy, .*all of the covariance, or none"),
        ({"cov_xx": -1.0, "rest": 0.0}, "not positive definite"),
    ],
)
def test_a_wrong_file_of_estimates_is_refused(
    task_set: TaskSet, tmp_path: Path, change: dict, told: str
) -> None:
    table = truth_table(task_set)
    if "drop" in change:
        table = table.drop(columns=change["drop"])
    if "task" in change:
        table.loc[0, "task"] = change["task"]
    if "twice" in change:
        table = pd.concat([table, table.iloc[:1]])
    if "text" in change:
        table = table.astype({"ty_m": object})
        table.loc[0, "ty_m"] = "left"
    for name in ("accepted", "cov_xx"):
        if name in change:
            table[name] = change[name]
    if "rest" in change:
        table = table.assign(cov_xy=0.0, cov_xt=0.0, cov_yy=1.0, cov_yt=0.0, cov_tt=1.0)
    table.to_csv(tmp_path / "mine.csv", index=False)
    with pytest.raises(InputError, match=told):
        read_estimates(tmp_path / "mine.csv", task_set)


def test_a_task_without_correspondences_has_no_estimate(task_set: TaskSet, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(task_set.folder, tmp_path / "tasks"))
    path, first = folder / "correspondences.parquet", task_set.tasks["task"].iloc[0]
    rows = read_rows(path, OFFERED)
    write_rows(path, OFFERED, rows[rows["task"] != first])
    (scenario,) = task_set.scenarios
    tasks = {each.name: each for each in tasks_of_scenario(folder, "another", scenario)}
    assert len(tasks[first].pair.offered) == 0
    assert max(len(each.pair.offered) for each in tasks.values()) > 0


def test_two_methods_of_one_name_are_refused(task_set: TaskSet, tmp_path: Path) -> None:
    truth_table(task_set).to_csv(tmp_path / "ransac.csv", index=False)
    entries, store = chosen_methods(["ransac"], only=True)[0], Store.of(tmp_path)
    with pytest.raises(InputError, match="ransac: is the name of another method"):
        run_leaderboard(task_set, entries, (), [tmp_path / "ransac.csv"], store, quiet)


def test_changed_fusers_are_run_again() -> None:
    """The key of a fuser's results covers all fusers' sources, which are loaded by name."""
    cell = leaderboard.FuserCell("folder", "digest", "tiny", "joint", "")
    stages = leaderboard.stages_of_scenario(cell.folder, cell.digest, "tiny", (), ("joint",))
    assert "mapfusion/fusion/joint.py" in imported_sources(*stages[1][0].loads)


def alignments(**aligners: tuple[float, float]) -> pd.DataFrame:
    """Errors of aligners on 20 runs, from their median error and their share of right answers.

    Half of the runs have common ground. There each aligner is right or misses; without common
    ground it refuses or merges falsely.
    """
    rng, rows = np.random.default_rng(0), []
    for run in range(20):
        for name, (error_m, share) in {"oracle": (0.01, 1.0), **aligners}.items():
            good, ground = rng.random() < share, run % 2 == 0
            accepted = good if ground else not good
            own_m = error_m * rng.uniform(0.9, 1.1) if ground and good else 9.0
            rows.append(
                {
                    "task": f"task-{run}",
                    "run_id": f"world-{run}",
                    "scenario": "world",
                    "seed": run,
                    "robot_a": "R1",
                    "robot_b": "R2",
                    "iteration": 10,
                    "aligner": name,
                    "repetition": 0,
                    "status": "accepted",
                    "accepted": accepted,
                    "lower_bound": False,
                    "alignment_nees": 3.0,
                    **dict.fromkeys(("translation_error_m", "refined_translation_error_m"), own_m),
                    **dict.fromkeys(("rotation_error_rad", "refined_rotation_error_rad"), 0.0),
                    "n_correspondences": 60,
                    "n_true": 50 if ground else 0,
                    "n_common": 80 if ground else 0,
                    "elapsed_s": 0.002,
                    "reference_s": 0.001,
                }
            )
    return pd.DataFrame(rows)


def test_more_right_decisions_rank_before_smaller_errors() -> None:
    ranks = rank_aligners(alignments(exact=(0.01, 0.3), sure=(0.03, 1.0))).set_index("aligner")
    assert ranks.index.tolist() == ["sure", "exact"]
    assert ranks["rank"].tolist() == [1, 2]
    assert ranks.loc["sure", "decisions"] == 1
    assert ranks.loc["sure", "missed"] == ranks.loc["sure", "false_merges"] == 0
    assert ranks.loc["exact", "missed"] + ranks.loc["exact", "false_merges"] == round(
        20 * (1 - ranks.loc["exact", "decisions"])
    )
    assert ranks["time_ratio"].tolist() == [2, 2]
    assert ranks["nees_per_dof"].tolist() == [1, 1]


def test_equal_decisions_are_ranked_by_error_and_ties_are_shown() -> None:
    ranks = rank_aligners(alignments(a=(0.03, 1.0), b=(0.01, 1.0), c=(0.03, 1.0)))
    assert dict(zip(ranks["aligner"], ranks["rank"], strict=True)) == {"b": 1, "a": 2, "c": 2}
    assert ranks["aligner"].iloc[0] == "b"
    assert ranks["estimated_ratio"].iloc[0] == pytest.approx(1, rel=0.1)


def test_the_order_of_the_rows_does_not_change_the_ranks() -> None:
    rows = alignments(a=(0.03, 0.9), b=(0.01, 0.8))
    turned = rank_aligners(rows.sort_values(["aligner", "seed"], ascending=[False, True]))
    columns = ["aligner", "rank", "decisions", "false_merges", "missed"]
    assert turned[columns].to_dict("records") == rank_aligners(rows)[columns].to_dict("records")


def test_fusers_rank_by_the_errors_of_their_landmarks() -> None:
    rng, rows = np.random.default_rng(0), []
    for run in range(12):
        scale = rng.uniform(0.5, 2)  # of a world, the same for all fusers
        for fuser, error_m in (("worse", 0.03), ("better", 0.01), ("same", 0.01)):
            own_m = scale * error_m * rng.uniform(0.8, 1.25)
            known = {"run_id": f"r{run}", "fuser": fuser, "landmark_rmse_m": own_m}
            known |= {"over_better_parent": own_m / 0.02, "nees_per_dof": 1.0, "coverage_95": 0.9}
            rows.append(known | {"duplicate_share": 0.0, "elapsed_s": 1.0, "reference_s": 2.0})
    ranks = rank_fusers(pd.DataFrame(rows)).set_index("fuser")
    assert ranks["rank"].to_dict() == {"better": 1, "same": 1, "worse": 3}
    assert ranks["time_ratio"].tolist() == [0.5] * 3


def test_a_fuser_without_an_rmse_ranks_last() -> None:
    rows = [
        {
            "run_id": f"r{run}",
            "fuser": fuser,
            "landmark_rmse_m": np.nan if fuser == "gross" else 0.01 + 0.001 * run,
            **dict.fromkeys(("over_better_parent", "nees_per_dof", "coverage_95"), 1.0),
            **dict.fromkeys(("duplicate_share", "elapsed_s", "reference_s"), 1.0),
        }
        for run in range(8)
        for fuser in ("gross", "good")
    ]
    ranks = rank_fusers(pd.DataFrame(rows))
    assert ranks["fuser"].tolist() == ["good", "gross"]
    assert ranks["rank"].tolist() == [1, 2]


def test_the_command_ranks_a_class_in_a_file(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(
        "from mapfusion.align.aligners import make_aligner\n"
        "class Mine:\n"
        "    randomised = True\n"
        "    def __init__(self):\n"
        "        self.inner = make_aligner('ransac')\n"
        "    def find(self, pairs, rng):\n"
        "        return self.inner.find(pairs, rng)\n"
    )
    folder = tmp_path / "board"
    arguments = ["study", "leaderboard", made / "tasks", "--only", "-o", folder]
    arguments += ["--method", f"{tmp_path / 'mine.py'}:Mine", "--method", "joint"]
    reply = command(capsys, *arguments, "--results", made)
    assert reply.code == 0, reply.err
    ranks = pd.read_csv(folder / "aligners.csv")
    assert set(ranks["aligner"]) == {"ransac", "Mine"}
    assert set(pd.read_csv(folder / "fusers.csv")["fuser"]) <= {"joint", "kalman-drift"}
    assert "Mine" in (folder / "leaderboard.html").read_text()
    origin = json.loads((folder / "provenance.json").read_text())
    assert origin["task_set"]["sha256"] == TaskSet.read(made / "tasks").digest
    assert origin["methods"]["Mine"]["files"]


def test_a_fuser_alone_is_ranked(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["study", "leaderboard", made / "tasks", "--only", "--method", "kalman"]
    reply = command(capsys, *arguments, "-o", tmp_path / "board", "--results", made)
    assert reply.code == 0, reply.err
    assert pd.read_csv(tmp_path / "board" / "aligners.csv").empty
    assert "No aligner was ranked" in (tmp_path / "board" / "leaderboard.html").read_text()


def test_bad_input_is_told_in_one_line(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = command(capsys, "study", "leaderboard", tmp_path, "--results", tmp_path)
    assert_refused(told, str(tmp_path), "study tasks")
    arguments = ["study", "leaderboard", made / "tasks", "--results", tmp_path]
    assert_refused(command(capsys, *arguments, "--method", "batch"), "batch", "logs")
    told = command(capsys, *arguments, "--method", "ransack")
    assert_refused(told, "--method ransack", "did you mean ransac")
    told = command(capsys, "study", "tasks", "mrclam7", "-o", tmp_path / "t")
    assert_refused(told, "mrclam7", "recording")
    alone = tmp_path / "alone.yaml"
    alone.write_text(re.sub(r"  - {name: R2.*\n", "", TINY), encoding="utf-8")
    told = command(capsys, "study", "tasks", alone, "-o", tmp_path / "t")
    assert_refused(told, "one robot")
    (tmp_path / "one.yaml").write_text(TINY, encoding="utf-8")
    (tmp_path / "two.yaml").write_text(TINY, encoding="utf-8")
    both = tmp_path / "one.yaml", tmp_path / "two.yaml"
    assert_refused(
        command(capsys, "study", "tasks", *both, "-o", tmp_path / "t"), "two.yaml", "tiny"
    )


def test_each_known_method_is_ranked_once() -> None:
    aligners, fusers = chosen_methods([])
    names = [entry.name for entry in aligners]
    assert {"ransac", "svd", "icp", "impicp", "clique", "gnc"} <= set(names)
    assert len(names) == len(set(names))
    assert "batch" not in fusers
    assert leaderboard.REFERENCE_FUSER in fusers


def test_the_published_ranking_is_that_of_its_own_errors() -> None:
    """Tables, provenance and card in the repository belong together and to this code."""
    folder = Path(__file__).parents[3] / "results" / "reference" / "leaderboard"
    card = json.loads((folder / CARD).read_text(encoding="utf-8"))
    files = {each["name"]: each["sha256"] for each in card["distribution"]}
    lines = "".join(f"{files[name]}  {name}\n" for name in sorted(files))
    provenance = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
    digest = hashlib.sha256(lines.encode()).hexdigest()
    assert provenance["task_set"] == {"version": card["version"], "sha256": digest}
    for name, rank in (("aligners", rank_aligners), ("fusers", rank_fusers)):
        errors = {"aligners": "alignments", "fusers": "fusions"}[name]
        found = rank(pd.read_parquet(folder / f"{errors}.parquet"))
        pd.testing.assert_frame_equal(found, pd.read_csv(folder / f"{name}.csv"), rtol=1e-6)
