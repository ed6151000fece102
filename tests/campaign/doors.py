"""One small file of each kind that we read, with the door that it is read through."""

from collections.abc import Callable
from dataclasses import astuple, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.evaluation import tables
from experiments.evaluation.tables import read_provenance
from experiments.pipeline.store import StageFolder, require_undamaged
from experiments.reports.figures.result_tables import ResultTables
from experiments.scenario.yaml_files import read_calibration
from experiments.studies.run_tables import find_runs
from experiments.studies.sweep_tables import JoinedTables, SweepDataset, SweepRun
from mapfusion.datasets.mrclam import MrclamSettings, import_mrclam
from mapfusion.datasets.point_logs import (
    PointsSettings,
    RangesSettings,
    import_points,
    import_ranges,
)
from mapfusion.datasets.stereo_recording import write_picture
from mapfusion.datasets.tum_rgbd import TumRgbdSettings, read_tum_rgbd
from mapfusion.descriptors import DescriptorKind
from mapfusion.files import write_json
from mapfusion.landmark_map import LandmarkMap, read_map, write_map
from mapfusion.robot_log import (
    Observations,
    RobotLog,
    read_log,
    read_truth,
    write_log,
    write_truth_points,
    write_truth_poses,
)
from sim.floorplan import FloorPlan, Wall
from sim.trajectory import Trajectory, read_trajectory, write_trajectory
from sim.world import CORNERS, face_files, read_corners, read_picture, write_faces


class Door(NamedTuple):
    """A file, and what reads it into values that can be compared."""

    path: Path
    read: Callable[[], Any]


def doors(folder: Path) -> list[Door]:
    """Write all kinds of files into an empty folder."""
    rng = np.random.default_rng(0)
    return [*_logs(folder, rng), *_of_a_result(folder, rng), *_of_the_store(folder, rng)]


def doors_of_others(folder: Path) -> list[Door]:
    """Write files without checksums, as other programs do: a changed number goes unnoticed."""
    plain, log, recording = folder / "plain.csv", folder / "csv", folder / "MRCLAM"
    rng, n = np.random.default_rng(1), 12
    place = pd.DataFrame(rng.normal(size=(n, 3)), columns=pd.Index(["x_m", "y_m", "z_m"]))
    spread = place.assign(cov_xx_m2=0.1, cov_xy_m2=0.0, cov_xz_m2=0.0)
    spread = spread.assign(cov_yy_m2=0.1, cov_yz_m2=0.0, cov_zz_m2=0.1)
    spread.to_csv(plain, index=False)
    log.mkdir()
    frames = pd.DataFrame({"iteration": range(4), "time_s": np.arange(4.0)})
    motion = {"odometry_x_m": 0.1, "odometry_y_m": 0.0, "odometry_theta_rad": 0.1}
    frames.assign(**motion).to_csv(log / "frames.csv", index=False)
    spread.assign(iteration=np.arange(n) // 3).to_csv(log / "observations.csv", index=False)
    tables = {
        "Barcodes": [(1, 5), (6, 72), (7, 27)],
        "Landmark_Groundtruth": [(6, 1.5, 1.0, 1e-4, 1e-4), (7, 2.0, -0.8, 1e-4, 1e-4)],
        "Robot1_Odometry": [(1000.0 + t, 0.2, 0.1) for t in range(6)],
        "Robot1_Measurement": [(1001.0 + t, 72, 1.0 + t, 0.1) for t in range(4)],
        "Robot1_Groundtruth": [(999.0 + t, 0.2 * t, 0.0, 0.1) for t in range(8)],
    }
    recording.mkdir()
    for name, rows in tables.items():
        text = "".join(" ".join(map(str, row)) + "\n" for row in rows)
        (recording / f"{name}.dat").write_text(text)
    settings = MrclamSettings()
    points, ranges = _point_logs(folder, rng)
    plan = FloorPlan((Wall(np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.4]]), 0.3),))
    write_faces(folder, plan, rng)
    imported = partial(import_mrclam, recording, folder / "imported", settings)
    return [
        Door(plain, partial(read_map, plain)),
        *(Door(log / f"{name}.csv", partial(read_log, log)) for name in ("frames", "observations")),
        *(Door(recording / f"{name}.dat", imported) for name in tables),
        *points,
        *ranges,
        *_rgbd(folder, rng),
        _bits(folder, spread, rng),
        Door(folder / CORNERS, partial(read_corners, folder / CORNERS)),
    ]


def _point_logs(folder: Path, rng: np.random.Generator) -> tuple[list[Door], list[Door]]:
    """Write logs of points, and of ranges and bearings, with their truth."""
    time_s = np.arange(6.0)
    pose = pd.DataFrame({"time_s": time_s, "x_m": 0.2 * time_s, "y_m": 0.0, "theta_rad": 0.1})
    velocity = pd.DataFrame({"time_s": time_s, "speed_m_s": 0.2, "turn_rate_rad_s": 0.1})
    seen, n = np.repeat(time_s, 2), 12
    point = {"x_m": rng.uniform(1, 3, n), "y_m": rng.normal(size=n), "label": np.arange(n) % 4}
    polar = {"range_m": rng.uniform(1, 3, n), "bearing_rad": rng.normal(size=n)}
    polar |= {f"descriptor_{k}": rng.normal(size=n) for k in range(3)}
    surveyed = {"label": range(4), "x_m": rng.normal(size=4), "y_m": 1.0, "z_m": 0.0}
    tables = {
        "points": {"odometry": pose, "points": pd.DataFrame({"time_s": seen, **point})},
        "ranges": {"odometry": velocity, "ranges": pd.DataFrame({"time_s": seen, **polar})},
    }
    noise = RangesSettings(range_sigma_m=0.1, bearing_sigma_rad=0.01)
    read: dict[str, Callable[[Path, Path], list[Path]]] = {
        "points": partial(import_points, settings=PointsSettings(sigma_m=0.1)),
        "ranges": partial(import_ranges, settings=noise),
    }
    found = dict[str, list[Door]]()
    for kind, own in tables.items():
        recording, truth = folder / f"log of {kind}", {"truth_poses": pose}
        truth |= {"landmarks": pd.DataFrame(surveyed)} if kind == "points" else {}
        recording.mkdir()
        for name, table in (own | truth).items():
            table.to_csv(recording / f"{name}.csv", index=False)
        imported = partial(read[kind], recording, folder / f"{kind} imported")
        found[kind] = [Door(recording / f"{name}.csv", imported) for name in own | truth]
    return found["points"], found["ranges"]


def _rgbd(folder: Path, rng: np.random.Generator) -> list[Door]:
    """Write recordings in the TUM RGB-D layout, with separate lists and with one."""
    found = list[Door]()
    camera = "cam0:\n  camera_model: pinhole\n  intrinsics: [20.0, 20.0, 15.5, 11.5]\n"
    camera += "  distortion_model: none\n  resolution: [32, 24]\n"
    pose = "".join(f"{k / 10:.1f} {0.1 * k:.1f} 0 0 0 0 0 1\n" for k in range(4))
    lists = {f"{kind}.txt": "" for kind in ("rgb", "depth")}
    both = ""
    for k in range(3):
        lists["rgb.txt"] += f"{k / 10:.1f} colour{k}.png\n"
        lists["depth.txt"] += f"{k / 10 + 0.01:.2f} depth{k}.png\n"
        both += f"{k / 10:.1f} colour{k}.png {k / 10 + 0.01:.2f} depth{k}.png\n"
    for name, own in (("lists", lists), ("one list", {"associations.txt": both})):
        recording = folder / f"TUM {name}"
        texts = own | {"groundtruth.txt": pose, "odometry.tum": pose, "calibration.yaml": camera}
        recording.mkdir()
        for file, text in texts.items():
            (recording / file).write_text(text)
        for k in range(3):
            levels = rng.integers(0, 256, (24, 32, 3), np.uint8)
            write_picture(recording / f"colour{k}.png", levels)
            depth = rng.integers(5000, 15000, (24, 32), np.uint16)
            write_picture(recording / f"depth{k}.png", depth)

        def read(recording: Path = recording) -> Any:
            made = read_tum_rgbd(recording, TumRgbdSettings(), read_calibration)
            pictures = [load() for each in made.pictures for load in each]
            return made.time_ns, pictures, made.truth, made.odometry, made.calibration

        files = (*texts, "colour1.png", "depth1.png")
        found += [Door(recording / file, read) for file in files]
    return found


def _bits(folder: Path, place: pd.DataFrame, rng: np.random.Generator) -> Door:
    """Write a map with packed binary descriptors, as other programs do."""
    path, looks = folder / "bits.csv", rng.integers(0, 256, (len(place), 4))
    names = pd.Index([f"descriptor_hamming_{k}" for k in range(4)])
    place.join(pd.DataFrame(looks, columns=names)).to_csv(path, index=False)
    return Door(path, partial(read_map, path))


def _points(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    root = rng.normal(size=(n, 3, 3))
    return rng.normal(size=(n, 3)), root @ np.swapaxes(root, 1, 2) + np.eye(3)


def _logs(folder: Path, rng: np.random.Generator) -> list[Door]:
    log, n = folder / "log", 12
    look = rng.normal(size=(n, 64)).astype(np.float32)
    seen = Observations(*_points(rng, n), look, np.arange(n, dtype=np.int32))
    iteration, odometry = np.repeat(np.arange(4), 3), rng.normal(size=(4, 3))
    write_log(log, RobotLog("R1", False, np.arange(4.0), odometry, iteration, seen))
    write_truth_poses(log, rng.normal(size=(4, 3)))
    write_truth_points(log, rng.normal(size=(n, 3)))
    measured = (log / f"{name}.parquet" for name in ("frames", "observations"))
    true = (log / f"truth_{name}.parquet" for name in ("poses", "points"))
    path = folder / "map.parquet"
    counts = np.arange(n, dtype=np.int32) + 1
    write_map(path, LandmarkMap(*_points(rng, n), counts, counts.astype(np.int64), look))
    orb, kind = folder / "orb.parquet", DescriptorKind("hamming", 256, "orb")
    bits = rng.integers(0, 256, (n, 32), np.uint8)
    packed = LandmarkMap(
        *_points(rng, n), counts, counts.astype(np.int64), bits, descriptor_kind=kind
    )
    write_map(orb, packed)
    described = folder / "orb log"
    seen = Observations(*_points(rng, n), bits, descriptor_kind=kind)
    write_log(described, RobotLog("R2", False, np.arange(4.0), odometry, iteration, seen))
    return [
        Door(orb, partial(read_map, orb)),
        Door(described / "observations.parquet", partial(read_log, described)),
        *(Door(each, partial(read_log, log)) for each in measured),
        *(Door(each, partial(read_truth, log)) for each in true),
        Door(path, partial(read_map, path)),
    ]


def _of_a_result(folder: Path, rng: np.random.Generator) -> list[Door]:
    result, sweep = folder / "result", SweepDataset(folder / "sweep", ("slam.every",))
    fits = tables.table_path(result, "map_fits")
    rows = {"map": ["R1", "fused"], "n_landmarks": [3, 4], "rmse_m": rng.normal(size=2)}
    tables.write(fits, "map_fits", pd.DataFrame(rows))
    write_json(result / "scenario.json", {"name": "x", "seed": 3, "description": "a\ud800"})
    write_json(result / "provenance.json", {"stages": {}, "libraries": {"numpy": "2"}})
    write_json(result / "world.json", {"walls": [[[0, 0], [1, 0]]], "robots": {"R1": [0, 1, 0.5]}})
    JoinedTables(sweep).ask_for([SweepRun(folder, "x", 0)])
    return [
        Door(fits, partial(tables.read, fits, "map_fits")),
        Door(fits, lambda: find_runs(result).read("map_fits")),
        Door(result / "scenario.json", lambda: find_runs(result).results[0].run),
        Door(result / "provenance.json", lambda: read_provenance(result / "provenance.json")),
        Door(result / "world.json", lambda: (ResultTables(result).walls, _start(result))),
        Door(sweep.folder / "sweep.json", lambda: JoinedTables(sweep).run_ids),
    ]


def _start(result: Path) -> Any:
    return ResultTables(result).start_pose("R1")


def _of_the_store(folder: Path, rng: np.random.Generator) -> list[Door]:
    faces, drive = folder / "store" / "faces" / "k", folder / "trajectory.parquet"
    driven = Trajectory(("R1",), np.arange(5.0), rng.normal(size=(1, 5, 3)), np.zeros((1, 5, 2)))
    write_trajectory(drive, driven)
    corner = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.4]])
    write_faces(faces, FloorPlan((Wall(corner, 0.3),)), rng)
    made = StageFolder(faces, "faces", "k", {"": (faces / "done.json",)})
    made.finish("", {"elapsed_s": 1.5})

    def read() -> Any:
        """Read a stage as the one after it does."""
        require_undamaged(faces)
        meshes = [file.read_bytes() for file in sorted(faces.glob("*.obj"))]
        pictures = [read_picture(file) for file in sorted(faces.glob("*.bmp"))]
        return made.quantities(), read_corners(faces / CORNERS), pictures, meshes

    return [
        Door(drive, partial(read_trajectory, drive)),
        *(Door(each, read) for each in (faces / "done.json", faces / CORNERS)),
        *(Door(each, read) for each in face_files(faces, 0)),
    ]


def same(before: Any, after: Any) -> bool:
    """Return True if two answers hold the same values; NaN equals NaN."""
    if type(before) is not type(after):
        return False
    if isinstance(before, pd.DataFrame):
        return before.equals(after)
    if is_dataclass(before) and not isinstance(before, type):
        before, after = astuple(before), astuple(after)
    if isinstance(before, tuple | list):
        return len(before) == len(after) and all(map(same, before, after))
    if isinstance(before, np.ndarray):
        return before.dtype == after.dtype and before.tobytes() == after.tobytes()
    return before == after
