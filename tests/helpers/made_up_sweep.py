"""A made-up sweep folder: the errors of a made-up result, scattered by seed and setting."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.evaluation import tables
from mapfusion.files import schema, write_table

KEY = "slam.filter.n_particles"
_RUN = ("run_id", "scenario", "seed", KEY)
_RUNS_FIELDS = ("status", "reason", "renderer", "stages", "libraries", "source_hash")


def write_sweep(folder: Path, result: Path, seeds: range, particles: tuple[str, ...]) -> Path:
    """Write runs over seeds and a setting; the last seed's runs failed."""
    folder.mkdir(parents=True)
    text = json.dumps({"schema_version": 1, "kind": "sweep", "settings": [KEY]})
    (folder / "sweep.json").write_text(text)
    for seed in seeds:
        for value in particles:
            run = {
                "run_id": f"made-up-{seed}-{value}",
                "scenario": "made-up",
                "seed": seed,
                KEY: value,
            }
            failed = seed == seeds[-1]
            _write_run(folder, run, failed)
            if not failed:
                for name in ("errors", "robots", "aligner_timings"):
                    rows = tables.read(tables.table_path(result, name), name)
                    _write(folder, name, run, _scattered(rows, seed), list(tables.ALL[name]))
    return folder


def _scattered(rows: pd.DataFrame, seed: int) -> pd.DataFrame:
    factor = np.random.default_rng(seed).uniform(0.7, 1.4)
    lengths = [name for name in rows if str(name).endswith(("error_m", "error_rad"))]
    return rows.assign(**{str(name): factor * rows[name] for name in lengths})


def _write_run(folder: Path, run: dict[str, object], failed: bool) -> None:
    row = dict.fromkeys(_RUNS_FIELDS, "")
    row |= {"status": "failed" if failed else "finished", "renderer": "TinyRenderer"}
    row |= {
        "reason": "<b>the disk</b> is full" if failed else "",
        "libraries": '{"numpy": "2.4.6"}',
    }
    fields = [pa.field(name, pa.string()) for name in _RUNS_FIELDS]
    _write(folder, "runs", run, pd.DataFrame([row]), fields)


def _write(
    folder: Path, name: str, run: dict[str, object], rows: pd.DataFrame, fields: list[pa.Field]
) -> None:
    described = [pa.field(key, pa.int64() if key == "seed" else pa.string()) for key in _RUN]
    columns = {key: [run[key]] * len(rows) for key in _RUN}
    columns |= {str(field.name): rows[field.name].to_numpy() for field in fields}
    path = folder / name / f"{run['run_id']}.parquet"
    write_table(path, columns, schema(f"sweep.{name}", 1, [*described, *fields]))
