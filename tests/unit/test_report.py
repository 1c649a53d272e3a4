"""One page that needs no other file, whatever images are called."""

import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.conftest import Demo
from tests.unit.conftest import Run
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.poses import Query, read_poses, write_poses, write_queries
from trigpoint_db.report.cases import choose_shown
from trigpoint_db.report.matches import HEIGHT_PX, draw_pair
from trigpoint_db.report.page import Section, Table, write_page
from trigpoint_db.report.results import read_results
from trigpoint_db.report.sections import error_section

EVIL = "<script>alert(1)</script>"


class Page(HTMLParser):
    """Collects what a page is made of."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.text = ""
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href")]

    def handle_data(self, data: str) -> None:
        self.text += data

    @property
    def is_self_contained(self) -> bool:
        return not {"script", "link", "iframe"} & set(self.tags) and all(
            address.startswith(("data:", "#")) for address in self.addresses
        )


@pytest.fixture(scope="module")
def evil_map(demo: Demo, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The demo's map, the first image of which is called as no image should be."""
    folder = tmp_path_factory.mktemp("evil")
    (folder / "images").mkdir()
    path = folder / "<b>map.tpmap"
    name = EVIL.replace("/", "") + ".jpg"
    with MapReader.open(demo.map) as reader, MapWriter.create(path, reader.model) as writer:
        for index in range(len(reader)):
            record = reader.record(index)
            writer.add_record(record, record.name if index else name)
            image = demo.folder / "survey" / record.name
            (folder / "images" / (record.name if index else name)).symlink_to(image)
    return path, folder / "images"


def test_a_report_on_a_map_shows_its_coverage_and_images(
    run: Run, evil_map: tuple[Path, Path], tmp_path: Path
) -> None:
    map_, images = evil_map
    out = tmp_path / "report.html"
    code, said, _ = run("report", map_, "-o", out, "--images", images, "--probes", 2, "--json")
    assert code == 0
    assert json.loads(said)["bytes"] == out.stat().st_size < 3e6
    page = Page(out)
    assert page.is_self_contained
    for title in ("Map", "Coverage", "Errors", "Times", "Some images and their anchors"):
        assert title in page.text
    assert EVIL.replace("/", "") in page.text  # as a text
    assert "<b>map.tpmap" in page.text
    assert page.tags.count("svg") == 3
    assert page.tags.count("img") >= 2


def test_a_report_on_results_shows_errors_times_and_refusals(
    run: Run, demo: Demo, tmp_path: Path
) -> None:
    truth = {image.name: image.cam_from_world for image in read_model(demo.folder / "sparse")}
    camera = read_model(demo.folder / "sparse")[0].camera
    names = ["000010.jpg", "000050.jpg", "000090.jpg"]
    queries, poses = tmp_path / "queries.txt", tmp_path / "poses.txt"
    results, out = tmp_path / "results.jsonl", tmp_path / "report.html"
    write_queries(queries, [Query(name, camera) for name in names])
    write_poses(tmp_path / "truth.txt", {name: truth[name] for name in names})
    asked = ["--images", demo.folder / "survey", "--queries", queries]
    code, *_ = run("localize", demo.map, *asked, "--poses", poses, "--results", results)
    assert code == 0
    lines = [json.loads(line) for line in results.read_text().splitlines()]
    found = read_poses(poses)
    lines[2] |= {"status": "LOST", "reason": "FEW_INLIERS", "detail": EVIL}
    results.write_text("".join(json.dumps(line) + "\n" for line in lines))
    write_poses(poses, {name: found[name] for name in names[:2]})
    more = ["--results", results, "--poses", poses, "--truth", tmp_path / "truth.txt", "-o", out]
    code, *_ = run("report", *more)
    assert code == 0
    page = Page(out)
    assert page.is_self_contained
    assert "FEW_INLIERS" in page.text
    assert "2 of 3 queries have a pose" in page.text
    assert "img" not in page.tags
    code, _, said = run("report", demo.map, *more, "--images", tmp_path, "--queries", queries)
    assert (code, "3 images are missing" in said) == (1, True)
    code, *_ = run("report", demo.map, *more, *asked)
    assert code == 0
    page = Page(out)
    assert page.is_self_contained
    assert "refused, FEW_INLIERS: 000090.jpg and its anchor 000090.jpg" in page.text
    assert page.tags.count("img") == 2 * 4  # the best, the median, the worst, the refused


def test_what_is_missing_for_a_report_is_said(run: Run, demo: Demo, tmp_path: Path) -> None:
    out, results = tmp_path / "r.html", tmp_path / "results.jsonl"
    results.write_text('{"name": "a.jpg"}\n')
    poses = tmp_path / "poses.txt"
    poses.write_text("a.jpg 1 0 0 0 0 0 0\n")
    of_results = ["--results", results, "--poses", poses, "--truth", poses]
    for arguments, said in (
        ([], "nothing to report on"),
        (["--results", results], "needs --poses and --truth"),
        ([demo.map, "--poses", poses], "--poses is for a report on --results"),
        (of_results, "is no result of"),
        *(
            ([*of_results, *drawn], "give MAP, --queries and --images")
            for drawn in (
                ["--images", tmp_path],
                [demo.map],
                ["--queries", poses],
                ["--map-images", tmp_path],
            )
        ),
        ([*of_results, "--probes", 5], "--probes is for a report on a MAP"),
        ([*of_results, "--apart", 0.2], "--apart is for a report on a MAP"),
        ([demo.map, "--images", tmp_path], "140 images are missing"),
        ([demo.map, "--map-images", tmp_path], "140 images are missing"),
    ):
        code, _, error = run("report", *arguments, "-o", out)
        assert code == 1
        assert said in error
    assert not out.exists()


@pytest.mark.parametrize("module", ["matplotlib", "jinja2"])
def test_what_is_not_installed_is_said_before_the_work(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    code, _, said = run("report", tmp_path / "missing.tpmap", "-o", tmp_path / "r.html")
    assert (code, "pip install 'trigpoint[plots]'" in said) == (1, True)


def test_a_page_takes_the_place_of_no_input(run: Run, demo: Demo) -> None:
    image = demo.folder / "survey" / "000010.jpg"
    before = image.read_bytes()
    code, _, said = run("report", demo.map, "-o", image, "--images", demo.folder / "survey")
    assert (code, "name it .html" in said) == (1, True)
    assert image.read_bytes() == before


@pytest.mark.parametrize(
    "line",
    [
        "",
        "[1]",
        '{"name": 5, "reason": null}',
        '{"name": ["a"], "reason": null}',
        '{"name": "a", "reason": [1]}',
        '{"name": "a", "reason": null, "stage_ms": 5}',
        '{"name": "a", "reason": null, "stage_ms": {"a": "x"}}',
        '{"name": "a", "reason": null, "stage_ms": {"a": NaN}}',
        '{"name": "a", "reason": null, "anchors": [1]}',
    ],
)
def test_lines_that_are_no_results_are_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text('{"name": "a", "reason": null}\n' + line + "\n")
    with pytest.raises(ConfigError, match=r"results\.jsonl:2: .* is no result of"):
        read_results(path)


def test_texts_are_escaped_and_figures_are_not(tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    table = Table([EVIL], [[EVIL]])
    write_page(out, EVIL, [Section(EVIL, EVIL, "<svg></svg>", table)])
    page = Page(out)
    assert "script" not in page.tags
    assert page.text.count(EVIL) == 6
    assert page.tags.count("svg") == 1


def test_errors_of_images_without_a_pose_count_as_failures() -> None:
    errors = np.array([0.1, 0.2, np.inf, np.inf])
    section = error_section(errors, 10 * errors, "")
    assert section.table is not None
    assert section.table.rows[0] == ["position", "no pose", "no pose", "no pose"]
    section = error_section(errors[:3], errors[:3], "")
    assert section.table is not None
    assert section.table.rows[0] == ["position", "0.2", "no pose", "no pose"]
    nothing = np.full(2, np.inf)
    assert "<svg" in error_section(nothing, nothing, "").svg
    colors = re.findall(r"(?:fill|stroke): (#\w+)", section.svg)
    assert "#000000" not in colors


def test_the_best_the_median_the_worst_and_refused_ones_are_shown() -> None:
    inf = float("inf")
    shown = choose_shown([0.3, inf, 0.1, 0.2, inf, inf, 0.4])
    assert shown == [
        ("the best", 2), ("the median", 0), ("the worst", 6), ("refused", 1), ("refused", 4),
    ]  # fmt: skip
    assert choose_shown([inf]) == [("refused", 0)]


def test_matches_are_drawn_where_they_are() -> None:
    left, right = np.zeros((420, 500), np.uint8), np.zeros((840, 600), np.uint8)
    jpeg = draw_pair(left, right, np.array([[100.0, 50.0]]), np.array([[400.0, 600.0]]))
    drawn = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert drawn is not None
    assert drawn.shape[:2] == (HEIGHT_PX, 500 + 8 + 300)
    assert drawn[50, 100].max() > 100
    assert drawn[300, 508 + 200].max() > 100
    assert drawn[200, 40].max() < 30
