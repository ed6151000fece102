"""Descriptors of any kind: distances, files, and the way from logs to a fused map."""

import itertools
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats

import mapfusion
from mapfusion.align.correspondences import match
from mapfusion.datasets.relative_motion import links
from mapfusion.descriptors import (
    USURF,
    DescriptorKind,
    Metric,
    as_vectors,
    euclidean_distance_at,
    guessed_kind,
    median_distance,
    merged_kind,
    pack_bits,
    relative_distance,
    require_one_kind,
    unpack_bits,
)
from mapfusion.errors import InputError, TellingWarning
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap, read_map, write_map
from mapfusion.robot_log import read_log, write_log
from tests.mapfusion.described_worlds import KINDS, SIFT, log_of, looks_of, two_maps


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def slow_hamming(a: bytes, b: bytes) -> int:
    """Return the number of different bits, counted in the binary text of each byte."""
    return sum(bin(x ^ y).count("1") for x, y in zip(a, b, strict=True))


def test_squared_distances_of_bits_are_hamming_distances(rng: np.random.Generator) -> None:
    packed = rng.integers(0, 256, (12, 5)).astype(np.uint8)
    vectors, kind = as_vectors(packed, None)
    assert (kind.metric, kind.length) == ("hamming", 40)
    np.testing.assert_array_equal(pack_bits(vectors), packed)
    for i, j in itertools.product(range(12), repeat=2):
        apart = slow_hamming(packed[i].tobytes(), packed[j].tobytes())
        assert np.sum((vectors[i] - vectors[j]) ** 2) == apart


def test_cosine_does_not_depend_on_the_length(rng: np.random.Generator) -> None:
    kind = DescriptorKind("cosine", 30)
    looks = rng.standard_normal((9, 30))
    vectors, found = as_vectors(looks, kind)
    longer, _ = as_vectors(looks * rng.uniform(0.1, 50, (9, 1)), kind)
    np.testing.assert_allclose(vectors, longer, rtol=1e-12)
    cosine = looks @ looks.T / np.outer(*2 * [np.linalg.norm(looks, axis=1)])
    apart2 = np.sum((vectors[:, None] - vectors) ** 2, axis=2)
    np.testing.assert_allclose(apart2, 2 - 2 * cosine, atol=1e-12)
    again, _ = as_vectors(vectors, found)
    assert again is vectors
    with pytest.raises(ValueError, match="row 4 is zero and has no direction"):
        as_vectors(np.where(np.arange(9)[:, None] == 4, 0, looks), kind)


def test_the_reference_is_the_median_distance_of_different_landmarks(
    rng: np.random.Generator,
) -> None:
    looks = rng.standard_normal((50, 7)) + 100
    pairs = itertools.combinations(looks, 2)
    expected = np.median([np.linalg.norm(a - b) for a, b in pairs])
    assert median_distance(looks) == pytest.approx(expected)
    assert median_distance(5 * looks[::-1]) == pytest.approx(5 * expected)
    assert median_distance(np.repeat(looks, 3, axis=0)) == pytest.approx(expected)
    gaps = np.vstack([looks, np.full((20, 7), np.nan)])
    assert median_distance(gaps) == pytest.approx(expected)
    many = rng.standard_normal((5000, 7))
    of_chi_square = np.sqrt(2 * scipy.stats.chi2.median(7))  # difference of two normal vectors
    assert median_distance(many) == pytest.approx(of_chi_square, rel=0.03)
    assert median_distance(np.ones((9, 7))) is None
    assert median_distance(looks[:1]) is None


@pytest.mark.parametrize("name", KINDS)
def test_different_landmarks_have_a_median_distance_of_08(
    name: str, rng: np.random.Generator
) -> None:
    vectors, kind = as_vectors(looks_of(KINDS[name], rng, 100), KINDS[name])
    apart = np.array([np.linalg.norm(a - b) for a, b in itertools.combinations(vectors, 2)])
    assert np.median(relative_distance(apart, kind)) == pytest.approx(0.8, rel=1e-5)
    assert relative_distance(euclidean_distance_at(0.3, kind), kind) == pytest.approx(0.3)
    if kind.metric == "hamming":  # the distance is the number of different bits
        assert relative_distance(np.sqrt(128), kind) == pytest.approx(
            2 * relative_distance(np.sqrt(64), kind)
        )
    assert euclidean_distance_at(0.3, USURF) == 0.3
    assert relative_distance(0.3, USURF, USURF) == 0.3


def test_the_kind_of_unknown_numbers(rng: np.random.Generator) -> None:
    looks = rng.standard_normal((9, 64))
    unit = looks / np.linalg.norm(looks, axis=1, keepdims=True)
    assert guessed_kind(unit) == USURF
    assert guessed_kind(looks) == guessed_kind(8 * unit) == DescriptorKind("euclidean", 64)
    flat = np.where(np.arange(9)[:, None] == 2, 0, unit)
    assert guessed_kind(flat) == USURF
    assert guessed_kind(unit[:, :32]) == DescriptorKind("euclidean", 32)


def test_kinds_are_compared_by_metric_length_and_name() -> None:
    unnamed = replace(SIFT, name="")
    assert not SIFT.differs_from(unnamed)
    assert not SIFT.differs_from(replace(SIFT, reference=3.0))
    others = [
        replace(SIFT, name="root_sift"),
        replace(unnamed, metric="cosine"),
        replace(SIFT, length=64),
        KINDS["orb"],
    ]
    assert all(SIFT.differs_from(other) and other.differs_from(SIFT) for other in others)
    two, eight = replace(SIFT, reference=2.0), replace(unnamed, reference=8.0)
    assert merged_kind(USURF, USURF) == USURF
    both = merged_kind(None, eight, two)
    assert both is not None
    assert both.reference == pytest.approx(4)
    assert both.name == "sift"
    require_one_kind([("a", SIFT), ("b", None), ("c", unnamed)])
    told = (
        r"b has descriptors of another kind \(hamming, 256 bits \(orb\)\) than a \(euclidean, 128"
    )
    with pytest.raises(InputError, match=told):
        require_one_kind([("a", SIFT), ("b", KINDS["orb"])])
    with pytest.raises(ValueError, match="did you mean cosine"):
        DescriptorKind("cosin", 3)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", KINDS)
def test_nearest_descriptors_are_those_of_a_slow_search(name: str) -> None:
    a, b = two_maps(KINDS[name])
    assert a.descriptor is not None
    assert b.descriptor is not None
    apart = np.linalg.norm(a.descriptor[:, None] - b.descriptor.astype(np.float64), axis=2)
    power = 2 if KINDS[name].metric == "hamming" else 1
    medians = [median_distance(own.descriptor) for own in (a, b)]
    apart = 0.8 * apart**power / np.sqrt(np.prod(medians)) ** power  # type: ignore[arg-type]
    nearest = apart.argmin(axis=1)
    rows = np.flatnonzero(apart.argmin(axis=0)[nearest] == np.arange(60))
    rows = rows[apart[rows, nearest[rows]] <= 0.6]
    found = match(a, b)
    np.testing.assert_array_equal(found.index_a, rows)
    np.testing.assert_array_equal(found.index_b, nearest[rows])
    np.testing.assert_allclose(found.distance, apart[rows, nearest[rows]], rtol=1e-4)
    assert np.count_nonzero(found.index_a == found.index_b + 20) == 40


@pytest.mark.parametrize("name", KINDS)
def test_distances_do_not_depend_on_the_unit_of_the_numbers(name: str) -> None:
    kind = KINDS[name]
    if kind.metric == "hamming":
        pytest.skip("bits have no unit")
    a, b = two_maps(kind)
    expected = match(a, b)
    shift = 0.0 if kind.metric == "cosine" else 4000.0
    scaled = [
        replace(own, descriptor=50 * own.descriptor + shift, descriptor_kind=kind)  # type: ignore[operator]
        for own in (a, b)
    ]
    found = match(scaled[0], scaled[1])
    np.testing.assert_array_equal(found.index_b, expected.index_b)
    np.testing.assert_allclose(found.distance, expected.distance, rtol=2e-3)


@pytest.mark.parametrize("ending", ["parquet", "csv", "ply"])
@pytest.mark.parametrize("name", KINDS)
def test_files_return_descriptors_and_kind(name: str, ending: str, tmp_path: Path) -> None:
    whole, _ = two_maps(KINDS[name])
    assert whole.descriptor is not None
    gaps = whole.descriptor.copy()
    gaps[3:5] = np.nan
    for given in (whole, replace(whole, descriptor=gaps)):
        write_map(tmp_path / f"m.{ending}", given)
        read = read_map(tmp_path / f"m.{ending}")
        np.testing.assert_allclose(read.descriptor, given.descriptor, rtol=1e-6)  # type: ignore[arg-type]
        assert read.descriptor_kind is not None
        assert given.descriptor_kind is not None
        assert not read.descriptor_kind.differs_from(given.descriptor_kind)
        if ending == "parquet":
            assert read.descriptor_kind == given.descriptor_kind
        table = LandmarkMap.from_pandas(given.to_pandas())
        np.testing.assert_allclose(table.descriptor, given.descriptor, rtol=1e-6)  # type: ignore[arg-type]
        assert not given.descriptor_kind.differs_from(table.descriptor_kind)  # type: ignore[arg-type]


def plain(n: int) -> pd.DataFrame:
    p = np.random.default_rng(0).uniform(0, 9, (n, 2))
    table = pd.DataFrame(p, columns=["x_m", "y_m"])
    return table.assign(cov_xx_m2=1e-4, cov_xy_m2=0.0, cov_yy_m2=1e-4)


def test_tables_of_other_programs_state_the_metric(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    packed = rng.integers(0, 256, (9, 4)).astype(np.uint8)
    bits = unpack_bits(packed)
    columns = [
        pd.DataFrame(packed, columns=[f"{name}{k}" for k in range(4)]) for name in ("d", "D_")
    ]
    plain(9).join(columns[1]).to_csv(tmp_path / "m.csv", index=False)
    plain(9).assign(descriptor=list(packed)).to_parquet(tmp_path / "m.parquet")
    for found in (
        LandmarkMap.from_pandas(plain(9).assign(descriptor=list(packed))),
        LandmarkMap.from_pandas(plain(9).join(columns[0])),
        LandmarkMap.from_pandas(plain(9).join(1.0 * columns[0]), descriptor_metric="hamming"),
        read_map(tmp_path / "m.csv", descriptor_metric="hamming"),
        read_map(tmp_path / "m.parquet"),
        read_map(tmp_path / "m.parquet", descriptor_metric="hamming"),
    ):
        np.testing.assert_array_equal(found.descriptor, bits)  # type: ignore[arg-type]
        assert str(found.descriptor_kind) == "hamming, 32 bits"
    told = "taken as euclidean, 4 numbers; if they are packed bits, name the column descriptor_ham"
    with pytest.warns(TellingWarning, match=told):
        assert read_map(tmp_path / "m.csv").descriptor_kind.length == 4  # type: ignore[union-attr]
    look = list(rng.standard_normal((9, 20)))
    cosine = LandmarkMap.from_pandas(plain(9).assign(descriptor_cosine=look))
    assert str(cosine.descriptor_kind) == "cosine, 20 numbers"


@pytest.mark.parametrize(
    ("columns", "metric", "said"),
    [
        ({"descriptor": [[1, 2], [3]]}, "", "lists of 1 and 2 numbers"),
        ({"descriptor": ["a", "b"]}, "", "column descriptor: .* \\(expected numbers\\)"),
        ({"descriptor_hamming": [[1.5, 2], [3, 4]]}, "", "packed bits are whole numbers"),
        ({"descriptor_hamming": [[256, 2], [3, 4]]}, "", "packed bits are whole numbers"),
        ({"descriptor_cosine": [[1.0, 2], [0, 0]]}, "", "row 1 is zero and has no direction"),
        ({"descriptor_cosine": [[1.0], [2]]}, "hamming", "of metric cosine, not hamming"),
        ({"descriptor": [[1.0], [2]], "descriptor_cosine": [[1.0], [2]]}, "", "two columns of des"),
        ({"descriptor": [[1.0], [2]], "descriptor_0": [1.0, 2]}, "", "two columns of descriptors"),
        ({"d0": [1.0, 2], "d2": [1.0, 2]}, "", "2 columns descriptor_0 to descriptor_2"),
        ({"descriptor": [[1.0], [2]]}, "haming", "did you mean hamming"),
        ({"descriptor": [[np.inf, 1], [2, 3]]}, "", "number 0 is inf in row 0"),
    ],
)
def test_wrong_descriptors_are_told_in_one_line(
    columns: dict[str, list[object]], metric: str, said: str
) -> None:
    with pytest.raises(InputError, match=said):
        LandmarkMap.from_pandas(plain(2).assign(**columns), descriptor_metric=metric)


def test_a_single_column_d0_is_no_descriptor() -> None:
    assert LandmarkMap.from_pandas(plain(2).assign(d0=[1.0, 2])).descriptor is None


@pytest.mark.parametrize("name", KINDS)
def test_maps_of_every_kind_are_aligned_and_merged(name: str, tmp_path: Path) -> None:
    paths = [tmp_path / f"{own.name}.parquet" for own in two_maps(KINDS[name])]
    for path, own in zip(paths, two_maps(KINDS[name]), strict=True):
        write_map(path, own)
    merged = mapfusion.merge_maps(paths)
    np.testing.assert_allclose(merged.alignments[0, 1].T_a_b, [2, 1, 0], atol=0.02)
    assert (merged.fused.parents >= 0).all(axis=1).sum() == 40
    for ending in ("csv", "parquet"):
        merged.write(tmp_path / f"f.{ending}")
        fused = read_map(tmp_path / f"f.{ending}")
        assert len(fused) == 80
        assert fused.descriptor_kind is not None
        assert not fused.descriptor_kind.differs_from(KINDS[name])
    # the fused map is a map like any other
    onto = mapfusion.align_maps(tmp_path / "f.parquet", paths[1])
    np.testing.assert_allclose(onto.T_a_b, [2, 1, 0], atol=0.02)


@pytest.mark.parametrize("fuser", ["kalman", "covariance_intersection"])
def test_other_fusers_associate_by_the_distance_of_the_kind(fuser: str) -> None:
    a, b = two_maps(KINDS["orb"])
    merged = mapfusion.merge_maps([a, b], fuser=fuser)
    assert merged.landmarks.descriptor_kind is not None
    assert merged.landmarks.descriptor_kind.name == "orb"
    assert (merged.fused.parents >= 0).all(axis=1).sum() == 40


def test_maps_of_different_kinds_are_refused_by_name(tmp_path: Path) -> None:
    a, b = two_maps(KINDS["orb"])[0], two_maps(SIFT)[1]
    write_map(tmp_path / "a.parquet", a)
    write_map(tmp_path / "b.parquet", b)
    told = r"b.parquet has descriptors of another kind \(.*sift.*\) than .*a.parquet \(.*orb"
    for call in (mapfusion.align_maps, lambda *maps: mapfusion.merge_maps(maps)):
        with pytest.raises(InputError, match=told):
            call(tmp_path / "a.parquet", tmp_path / "b.parquet")
    with pytest.raises(InputError, match="map south has descriptors of another kind"):
        match(a, b)


@pytest.mark.parametrize("name", KINDS)
def test_logs_of_every_kind_become_a_fused_map(name: str, tmp_path: Path) -> None:
    kind, maps = KINDS[name], []
    for robot, start in {"R1": [0.5, -1.5, 0.0], "R2": [-0.5, 1.5, 3.0]}.items():
        write_log(tmp_path / robot, log_of(kind, robot, start))
        log = read_log(tmp_path / robot)
        assert log.observations.descriptor_kind is not None
        assert not log.observations.descriptor_kind.differs_from(kind)
        settings = mapfusion.FastSlamParameters(n_particles=30)
        maps.append(mapfusion.build_map(log, settings, np.random.default_rng(1)))
        # as many landmarks as there are: the filter knows them again
        n_seen = len(np.unique(log.observations.descriptor, axis=0))
        assert 60 < len(maps[-1]) <= 150 < n_seen
        assert maps[-1].descriptor_kind == log.observations.descriptor_kind
    found = mapfusion.align_maps(*maps)
    assert found.accepted
    x, y, theta = found.T_a_b
    assert np.hypot(x + 1, y - 3) < 0.15
    assert abs(theta - 3) < 0.05
    merged = mapfusion.merge_maps(maps)
    assert (merged.fused.parents >= 0).all(axis=1).sum() > 30


@pytest.mark.parametrize("name", KINDS)
def test_frames_of_a_log_are_linked_by_descriptors_of_every_kind(name: str) -> None:
    kind = KINDS[name]
    log = log_of(kind, "R1", [0.5, -1.5, 0.0])
    starts = log.frame_starts()
    first, second = links(log, starts, 3, 4)
    p, q = log.observations.position_m[first], log.observations.position_m[second]
    assert len(first) > 0.8 * min(starts[4] - starts[3], starts[5] - starts[4])
    # one step of 0.15 m and 0.12 rad: all links agree with it
    moved = se2.transform_points(se2.inverse([0.15, 0.0, 0.12]), p)
    assert np.max(np.abs(moved - q)) < 0.15


def test_a_filter_refuses_descriptors_of_another_kind() -> None:
    slam = mapfusion.FastSlam(mapfusion.FastSlamParameters(n_particles=3), np.random.default_rng(0))
    for metric, length in (("euclidean", 128), ("cosine", 128)):
        kind = DescriptorKind(_metric(metric), length)
        seen = mapfusion.Observations(
            np.ones((2, 3)) * [[1], [2]],
            np.tile(np.eye(3), (2, 1, 1)),
            np.ones((2, 128)),
            descriptor_kind=kind,
        )
        if metric == "euclidean":
            slam.step(np.zeros(3), seen)
        else:
            with pytest.raises(
                ValueError, match="descriptor: is cosine, 128 numbers, earlier ones"
            ):
                slam.step(np.zeros(3), seen)


def _metric(name: str) -> Metric:
    return name  # type: ignore[return-value]


def test_a_wrong_cell_of_packed_bits_is_named_by_column_and_row(tmp_path: Path) -> None:
    table = plain(9).assign(**{f"descriptor_hamming_{k}": np.arange(9.0) for k in range(4)})
    table.loc[5, "descriptor_hamming_2"] = np.nan
    table.to_csv(tmp_path / "m.csv", index=False)
    with pytest.raises(
        InputError,
        match=r"hamming_2: is nan in row 5; packed .*; a row without descriptor has all",
    ):
        read_map(tmp_path / "m.csv")


def test_bits_that_an_empty_row_turned_into_floats_are_told(rng: np.random.Generator) -> None:
    packed = rng.integers(0, 256, (9, 32)).astype(np.uint8)
    columns = pd.DataFrame(packed, columns=[f"descriptor_{k}" for k in range(32)])
    a = LandmarkMap.from_pandas(plain(9).join(columns), "a")
    gap = columns.astype(float)
    gap.loc[3] = np.nan
    with pytest.warns(TellingWarning, match="if they are packed bits"):
        b = LandmarkMap.from_pandas(plain(9).join(gap), "b")
    for maps in ((a, b), (b, a)):
        told = "if those of map b are packed bits, .*give --descriptor-metric hamming"
        with pytest.raises(InputError, match=told):
            match(*maps)
    mended = LandmarkMap.from_pandas(plain(9).join(gap), "b", descriptor_metric="hamming")
    assert str(mended.descriptor_kind) == "hamming, 256 bits"
    assert mended.descriptor is not None
    np.testing.assert_array_equal(np.isnan(mended.descriptor).all(axis=1), np.arange(9) == 3)


def test_numbers_that_are_no_bits_are_told(rng: np.random.Generator) -> None:
    looks = np.abs(rng.standard_normal((40, 128)))
    looks *= 512 / np.linalg.norm(looks, axis=1, keepdims=True)
    for numbers in (np.round(looks), np.round(looks).astype(np.uint8)):
        with pytest.warns(TellingWarning, match="all rows have the norm 512; numbers of SIFT"):
            LandmarkMap.from_pandas(
                plain(40).assign(descriptor=list(numbers)), descriptor_metric="hamming"
            )
    with pytest.raises(InputError, match="numbers that are no bits have the metric euclidean"):
        LandmarkMap.from_pandas(
            plain(40).assign(descriptor=list(looks)), descriptor_metric="hamming"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for width in (32, 128):
            packed = list(rng.integers(0, 256, (40, width)).astype(np.uint8))
            LandmarkMap.from_pandas(plain(40).assign(descriptor=packed))
