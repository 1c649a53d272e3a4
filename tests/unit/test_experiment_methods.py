"""The experiments on methods and on time, in small: a corner of a rendered room."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.conftest import DATA
from tests.unit.conftest import Run
from tests.unit.posed_sets import write_set
from trigpoint.database.reader import MapReader
from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map
from trigpoint_db.experiments import hloc, methods, timing
from trigpoint_db.experiments.sets import read_splits
from trigpoint_db.experiments.store import Store, read_result
from trigpoint_db.methods.registry import MethodName

PAPER = DATA.parent / "seed"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_set(folder / "corner", 11)
    return folder


def check_picture(path: Path) -> None:
    picture = cv2.imread(str(path))
    assert picture is not None
    assert picture.std() > 5
    assert path.stat().st_size < 150_000


def test_all_methods_are_compared_on_the_same_queries(data: Path, tmp_path: Path, run: Run) -> None:
    code, out, err = run("experiment", "methods", "--data", data, "--output", tmp_path)
    assert code == 0, err
    result = read_result(tmp_path / "methods.json")
    assert [row["set"] for row in result["rows"]] == ["corner", "corner, block"]
    assert set(MethodName) - set(result["methods"]) <= {"map-pnp"}
    found = result["rows"][0]["methods"]
    assert 0 < found["latent-points"]["median"] < 0.02 < found["retrieval"]["median"]
    for summary in found.values():
        assert summary["num_lost"] == 0
        assert summary["ms"] > 0
    assert out.strip() == methods.write_table(result)
    check_picture(tmp_path / "methods.png")


def summary(median: float | None, num_lost: int = 0) -> dict[str, float | None]:
    p90 = None if median is None else 2 * median
    return {"median": median, "p90": p90, "median_deg": 1.0, "num_lost": num_lost, "ms": 1.0}


def test_the_table_says_who_won_and_who_lost_queries() -> None:
    rows = [
        {
            "set": name,
            "num_queries": 30,
            "num_chosen": 10,
            "methods": {"midpoint": summary(theirs), "latent-points": summary(ours, lost)},
        }
        for name, theirs, ours, lost in (
            ("hall", 0.4, 0.1, 1),
            ("yard", 0.2, 0.2, 0),
            ("roof", 0.1, None, 6),
        )
    ]
    names = ["midpoint", "latent-points"]
    settings = {"network": "base", "num_anchors": 20, "max_queries": 10}
    table = methods.write_table(settings | {"methods": names, "rows": rows})
    assert "midpoint in 2 of 3 rows, latent-points in 1 of 3 rows" in table
    assert "| hall | 0.4 | 0.1 (1) |" in table
    assert "| roof | 0.1 | - (6) |" in table
    assert "| over that of latent-points | 2 | 1 |" in table
    assert methods.MISSING in table
    assert "At most 10 queries of each set" in table


def test_time_and_storage_are_measured_by_stage(data: Path, tmp_path: Path, run: Run) -> None:
    command = "experiment", "timing", "--data", data, "--output", tmp_path, "--queries", 2
    code, out, err = run(*command)
    assert code == 0, err
    result = read_result(tmp_path / "timing.json")
    assert [row["anchors"] for row in result["rows"]] == ["9", timing.AS_NEEDED]  # all there are
    for row in result["rows"]:
        assert row["pipeline"] == "ours"
        assert row["num_found"] == 2
        assert row["num_anchors"] <= 9
        assert all(row["ms"][stage] > 0 for stage in timing.STAGES)
        assert max(row["ms"].values()) == row["ms"]["total"]
    assert 30_000 < result["bytes"]["ours"] < 200_000
    assert "hloc is not here" in out
    assert out.strip() == timing.write_table(result)
    check_picture(tmp_path / "timing.png")


def test_a_folder_that_is_no_checkout_of_hloc_is_refused(
    data: Path, tmp_path: Path, run: Run
) -> None:
    command = "experiment", "timing", "--data", data, "--output", tmp_path, "--queries", 1
    code, _, err = run(*command, "--hloc", tmp_path)
    assert code == 1
    assert f"{tmp_path} is not a checkout of hloc" in err


def test_timing_goes_on_with_the_queries_that_are_not_done(
    data: Path, tmp_path: Path, model: FeatureModel
) -> None:
    sets = {"corner": read_splits(data)["corner"]}
    first = timing.measure(sets, model, None, 1, Store(tmp_path))
    again = timing.measure(sets, model, None, 1, Store(tmp_path))
    assert again == first  # to the microsecond: nothing was measured twice


def test_beside_hloc_the_table_compares_stage_by_stage() -> None:
    ms = {"features": 10.0, "retrieval": 1.0, "matching": 20.0, "localization": 30.0, "total": 61.0}
    rows = [
        {"anchors": anchors, "pipeline": pipeline, "num_anchors": 20, "num_found": 2, "ms": spent}
        for anchors in ("20", "50", "150")
        for pipeline, spent in (("ours", ms), ("hloc", {key: 2 * ms[key] for key in ms}))
    ]
    result = {
        "network": "base", "sets": ["hall"], "num_mapped": 400, "largest": 60,
        "num_queries": 4, "num_chosen": 2, "rows": rows,
        "bytes": {"ours": 70e3, timing.HLOC_FEATURES: 100e3, timing.HLOC_MODEL: 40e3},
    }  # fmt: skip
    table = timing.write_table(result)
    assert "50 anchors: times of ours are 0.5 of hloc's matching" in table
    assert "ours is 0.5 of hloc's" in table
    assert "| hloc's together | 140,000 |" in table
    assert "hloc is not here" not in table
    assert "No set has more than 60 images: of 150 anchors" in table


@pytest.mark.skipif(not PAPER.is_dir(), reason=f"needs the paper's source in {PAPER}")
def test_the_papers_claims_are_those_it_makes() -> None:
    source = "".join(path.read_text() for path in sorted(PAPER.glob("*.txt")))
    faster, smaller = timing.PAPER_CLAIMS_PERCENT
    assert re.search(rf"timing improves {faster}\\% .* by~{smaller}\\%", source)


def test_hloc_gets_each_images_best_neighbours_and_features_in_half_precision(
    data: Path, tmp_path: Path, model: FeatureModel
) -> None:
    h5py = pytest.importorskip("h5py")
    dataset = read_splits(data)["corner"]
    build_map(tmp_path / "m.tpmap", dataset.mapped, dataset.images, model)
    with MapReader.open(tmp_path / "m.tpmap") as reader:
        anchors = {anchor.name: anchor for anchor in map(reader.anchor, range(len(reader)))}
        hloc.write_features(tmp_path / "f.h5", {"0": reader.features(0)})
        keypoints = reader.features(0).keypoints
    matches = hloc.match_map(anchors)
    assert len(matches) == 9 * 8 // 2  # fewer images than neighbours: all pairs
    with h5py.File(tmp_path / "f.h5") as file:
        written = file["0/keypoints"][:]
    assert written.dtype == np.float16
    np.testing.assert_allclose(written, keypoints, atol=0.13)
