"""The pages are one file, load in a real browser without errors, and answer to slider and mouse."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from improvo.cli.main import main
from improvo.evaluation.trajectory.protocol import evaluate_trajectory
from improvo.files import write_png
from improvo.report.charts import line_chart
from improvo.report.improvement_page import Measure, Round, write_improvement_page
from improvo.report.page import Page
from improvo.report.plain_words import ranges, warnings
from improvo.report.true_path import true_path
from improvo.types import Trajectory

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@pytest.fixture(scope="module")
def page(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a run."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    assert main(["report", str(finished_run), "-o", str(path)]) == 0
    return path


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Any]:
    """Headless Chromium."""
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("needs Chromium and ChromeDriver on the PATH (Debian: chromium, chromium-driver)")
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium: pip install 'improvo[dev]'")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


def until(condition: Any, seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the page did not answer"
        time.sleep(0.05)


def test_page_is_one_file_without_network(page: Path) -> None:
    text = page.read_text()
    markup = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.findall(r"(?:src|href)=\"(?!data:)[^\"]*\"", markup)
    assert "http://" not in text
    assert "https://" not in text
    assert page.stat().st_size < 3e6


def test_no_page_names_the_folders_of_this_machine_and_each_names_its_recording(
    page: Path, finished_run: Path, tmp_path: Path
) -> None:
    labels, evaluation = tmp_path / "labels", tmp_path / "evaluation"
    walk = finished_run.parent / "walk"
    words = [str(walk), "-o", str(labels), "--frontend", "orb", "--max-keypoints", "400"]
    assert main(["label", *words]) == 0
    truth = str(finished_run / "trajectory.txt")
    assert main(["evaluate", "trajectory", str(finished_run), truth, "-o", str(evaluation)]) == 0
    pages = [page]
    for folder in (labels, evaluation):
        assert main(["report", str(folder)]) == 0
        pages.append(folder / "report.html")
    for path in pages:
        text = path.read_text()
        assert str(tmp_path) not in text
        assert str(finished_run.parent) not in text
        title = re.search("<title>(.*)</title>", text)
        assert title is not None
        assert "walk" in title[1] or "out" in title[1]  # the recording, or the estimate


def test_browser_loads_it_without_errors_and_slider_and_map_respond(page: Path, browser: Any) -> None:
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    browser.get(page.as_uri())
    frame, scene = browser.find_element("id", "frame"), browser.find_element("id", "scene")
    until(lambda: frame.get_attribute("data-frame") is not None)
    first, camera = frame.get_attribute("data-frame"), scene.get_attribute("data-camera")

    slider = browser.find_element("id", "frame-slider")
    slider.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    until(lambda: int(frame.get_attribute("data-frame")) == int(first) + 3)
    until(lambda: int(scene.get_attribute("data-camera")) == int(camera) + 3)  # the map follows the frame

    def pixels() -> str:
        return str(browser.execute_script("return document.getElementById('frame').toDataURL()"))

    with_tracks = pixels()
    browser.find_element("css selector", "input[name=overlay][value=labels]").click()
    until(lambda: frame.get_attribute("data-overlay") == "labels")
    assert pixels() != with_tracks
    legends = browser.find_elements("css selector", "[data-legend]")
    assert [legend.get_attribute("data-legend") for legend in legends if legend.is_displayed()] == ["labels"]

    yaw = scene.get_attribute("data-yaw")
    ActionChains(browser).move_to_element(scene).click_and_hold().move_by_offset(60, 10).release().perform()
    until(lambda: scene.get_attribute("data-yaw") != yaw)
    browser.find_element("css selector", "input[name=layer][value=labels]").click()
    until(lambda: scene.get_attribute("data-layer") == "labels")
    assert browser.find_element("id", "scene-labels").is_displayed()
    distance = scene.get_attribute("data-distance")
    scene.send_keys("+")
    until(lambda: float(scene.get_attribute("data-distance")) < float(distance))
    lit = browser.execute_script(
        "const c=document.getElementById('scene'), d=c.getContext('2d').getImageData(0,0,c.width,c.height).data;"
        "let n=0; for (let i=0;i<d.length;i+=4) if (Math.max(d[i],d[i+1],d[i+2])>120) n++; return n"
    )
    assert lit > 300, "the map is empty"
    assert browser.get_log("browser") == []


def test_it_fits_a_phone(page: Path, browser: Any) -> None:
    size = {"width": 390, "height": 800, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(page.as_uri())
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    # the picture from above has a form of its own, whose letters can be read
    wide, shown = browser.execute_script(
        "const p = document.querySelector('picture img'); return [p.src.length, p.currentSrc.length]"
    )
    assert shown != wide


def test_dark_screens_print_on_white(page: Path, browser: Any) -> None:
    dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", dark)
    browser.get(page.as_uri())
    ink = "return getComputedStyle(document.body).color"
    assert browser.execute_script(ink) == "rgb(232, 234, 237)"
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {**dark, "media": "print"})
    assert browser.execute_script(ink) == "rgb(29, 33, 38)"


def test_report_without_its_recording_says_so(finished_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "out"
    shutil.copytree(finished_run, run)
    report = run / "run.json"
    report.write_text(report.read_text().replace(str(finished_run.parent / "walk"), str(tmp_path / "gone")))
    assert main(["report", str(run)]) == 0
    text = (run / "report.html").read_text()
    assert "not there any more" in text
    assert 'id="frame-slider"' not in text
    assert 'id="scene"' in text


def test_folders_with_spaces_are_left_out_too(finished_run: Path, tmp_path: Path) -> None:
    home = tmp_path / "jane doe" / "my videos"
    home.mkdir(parents=True)
    walk, run = home / "walk", home / "run"
    shutil.copytree(finished_run.parent / "walk", walk)
    shutil.copytree(finished_run, run)
    content = json.loads((run / "run.json").read_text())
    content["input"].update(path=str(walk), notes=[f"{walk}: is only a test"])
    content["input"]["skipped"] = [{"source": str(walk / "000007.png"), "reason": "is damaged \ud83d"}]
    content["configuration"]["sequence"].update(mask="C:\\Users\\jane\\mask.png", camera=str(walk / "camera.yaml"))
    (run / "run.json").write_text(json.dumps(content))
    assert main(["report", str(run)]) == 0
    text = (run / "report.html").read_text()
    assert "jane" not in text
    assert "my videos" not in text
    for word in ("walk: is only a test", "first is walk/000007.png", "mask.png", "camera.yaml", "is damaged \ufffd"):
        assert word in text


def test_text_of_others_is_escaped(tmp_path: Path) -> None:
    page = Page("<script>alert(1)</script>", "a & b")
    page.table(["<b>", "x"], [["**1**", "</td>"]])
    page.script("scene.js", "some-data", {"name": "</script><img>"})
    page.write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "<script>alert" not in text
    assert "</script><img>" not in text
    assert "<b>1</b>" in text
    data = re.search(r'id="some-data">(.*?)</script>', text)
    assert data is not None
    assert json.loads(data[1]) == {"name": "</script><img>"}


def report(**changes: Any) -> dict[str, Any]:
    result: dict[str, Any] = {
        "interrupted": False,
        "frames": {"processed": 10, "tracked": 10, "lost": 0, "lost_frames": []},
        "segments": [{"first": 0}],
        "events": [],
        "input": {"skipped": [], "notes": []},
    }
    return result | changes


def words(content: dict[str, Any], brightness: float = 120.0, error: float = 0.4) -> str:
    return " ".join(warnings(content, np.arange(3), np.array([brightness, 120, 120]), error))


def test_a_good_run_has_no_warnings() -> None:
    assert words(report()) == ""


def test_what_is_wrong_is_said_in_plain_words() -> None:
    lost = {"processed": 10, "tracked": 7, "lost": 3, "lost_frames": [4, 5, 6]}
    event = {"frame_index": 4, "kind": "lost", "detail": "only 3 points of the map found"}
    text = words(report(frames=lost, events=[event]))
    assert "Lost at frame 4" in text
    assert "3 of 10 frames have no pose: 4-6" in text
    none = {"processed": 10, "tracked": 0, "lost": 10, "lost_frames": list(range(10))}
    waiting = {"frame_index": 2, "kind": "initialising", "detail": "too little parallax"}
    assert "too little parallax" in words(report(frames=none, events=[waiting]))
    assert "Dark frames (mean grey value under 25 of 255): 0" in words(report(), brightness=9.0)
    assert "2 segments" in words(report(segments=[{"first": 0}, {"first": 6}]))
    verdict = {"word": "doubtful", "evidence": ["the parts disagree"], "uncertain": [], "error_percent": 8.0}
    doubted = {"number": 0, "first": 0, "last": 9, "verdict": verdict}
    said = words(report(segments=[doubted]))
    assert "Segment 0 (frames 0 to 9) is doubtful: the parts disagree." in said
    assert "makes no labels" in said
    assert "zoomed" not in said
    zoomed = {**doubted, "verdict": {**verdict, "evidence": ["the focal length changes"]}}
    assert "zoomed" in words(report(segments=[zoomed]))
    assert "Check the calibration" in words(report(), error=2.5)
    skipped = [{"index": 3, "source": "a.png", "reason": "truncated"}]
    assert "a.png: truncated" in words(report(input={"skipped": skipped, "notes": []}))


def test_every_loss_is_told() -> None:
    events = [{"kind": "lost", "frame_index": 10 * number, "detail": "too few points"} for number in range(1, 9)]
    said = words(report(events=events))
    assert "Lost at frame 50: too few points." in said
    assert "Lost 3 times more, at frames 60, 70, 80." in said


def test_ranges_are_short() -> None:
    assert ranges([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"
    assert ranges(list(range(0, 40, 2))).endswith("and 12 more stretches")


def test_chart_leaves_gaps_where_there_is_nothing() -> None:
    x = np.arange(10.0)
    y = np.where((x == 4) | (x == 5), np.nan, x)
    svg = line_chart(x, y, "a < b")
    assert svg.count("<polyline") == 2
    assert "a &lt; b" in svg
    assert line_chart(x, np.full(10, np.nan), "nothing").count("<polyline") == 0


def test_names_with_bars_stay_in_their_cell(tmp_path: Path) -> None:
    from improvo.evaluation.tables import markdown

    text = markdown(["what", "a"], [["attic | morning", "1"], ["two\nlines", "2|"]])
    assert len(text.splitlines()) == 4
    page = Page("tables", "of names")
    page.markdown(text)
    page.markdown("| plain | b |\n|---|--:|\n| c | d |\n")
    page.write(tmp_path / "page.html")
    rows = re.findall("<tr>(.*?)</tr>", (tmp_path / "page.html").read_text())
    assert [re.findall("<t[hd]>(.*?)</t[hd]>", row) for row in rows] == [
        *(["what", "a"], ["attic | morning", "1"], ["two\\nlines", "2|"]),
        *(["plain", "b"], ["c", "d"]),
    ]


def test_a_true_path_with_gaps_is_as_long_as_it_is() -> None:
    """Where every second frame has no truth, the error is a share of the whole path all the same.

    It is the error that `improvo evaluate trajectory` gives.
    """
    angle = np.linspace(0, 3, 60)
    true = np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1)
    estimate = 0.5 * true + np.random.default_rng(0).normal(0, 0.004, true.shape)
    found = []
    for without in (slice(0, 0), slice(1, None, 2), slice(20, 40)):
        poses = np.tile(np.eye(4), (60, 1, 1))
        poses[:, :3, 3] = true
        poses[without] = np.nan
        estimated = np.tile(np.eye(4), (60, 1, 1))
        estimated[:, :3, 3] = estimate
        sequence = SimpleNamespace(ground_truth=Trajectory(np.arange(60.0), poses), indices=np.arange(60))
        run = SimpleNamespace(
            trajectory=Trajectory(np.arange(60.0), estimated),
            sequence=sequence,
            source_index=list(range(60)),
            frame_indices=np.arange(60),
        )
        path = true_path(run)  # type: ignore[arg-type]
        assert path is not None
        assert (np.isfinite(path.centers[:, 0]) == np.isfinite(poses[:, 0, 0])).all()
        found.append(path.ate_percent)
        evaluated = evaluate_trajectory(run.trajectory, sequence.ground_truth)
        assert evaluated.ate_percent == pytest.approx(path.ate_percent, rel=1e-12)
        assert evaluated.ate_m is not None
        scale = evaluated.segments[0].scale
        distances = np.linalg.norm(path.centers - estimate, axis=1)
        assert scale * np.sqrt(np.nanmean(distances**2)) == pytest.approx(evaluated.ate_m.rmse, rel=1e-9)
        drawn = np.isfinite(path.drawn()[:, 0])
        assert drawn[:59].all() if without.step == 2 else (drawn == np.isfinite(path.centers[:, 0])).all()
    np.testing.assert_allclose(found, 100 * 0.004 * np.sqrt(3) / 1.505, rtol=0.2)


def test_the_error_of_segments_with_units_of_their_own_is_that_of_the_evaluation() -> None:
    """Errors are told in the unit of the truth, or a segment with large units would count for more."""
    angle = np.linspace(0, 3, 60)
    poses, estimated = np.tile(np.eye(4), (60, 1, 1)), np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, 3] = np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1)
    off = np.random.default_rng(0).normal(0, 1, (60, 3)) * np.where(np.arange(60) < 30, 0.02, 0.001)[:, None]
    segment = (np.arange(60) >= 30).astype(np.int64)
    estimated[:, :3, 3] = np.where(segment == 0, 0.2, 5.0)[:, None] * (poses[:, :3, 3] + off)
    truth, estimate = Trajectory(np.arange(60.0), poses), Trajectory(np.arange(60.0), estimated, segment)
    run = SimpleNamespace(
        trajectory=estimate,
        sequence=SimpleNamespace(ground_truth=truth, indices=np.arange(60)),
        source_index=list(range(60)),
        frame_indices=np.arange(60),
    )
    path = true_path(run)  # type: ignore[arg-type]
    assert path is not None
    assert path.ate_percent == pytest.approx(evaluate_trajectory(estimate, truth).ate_percent)


def test_chart_shows_a_value_that_stands_alone() -> None:
    """One frame, or one with a pose between frames that have none."""
    assert line_chart(np.zeros(1), np.ones(1), "one").count("<circle") == 1
    svg = line_chart(np.arange(5.0), np.array([1.0, 2.0, np.nan, 4.0, np.nan]), "some")
    assert (svg.count("<polyline"), svg.count("<circle")) == (1, 1)
    assert '<circle cx="687.0" cy="28.0"' in svg


@pytest.mark.parametrize("last", [6, 8, 11, 29, 1000])
def test_chart_writes_numbers_where_they_stand(last: int) -> None:
    x = np.arange(last + 1.0)
    svg = line_chart(x, x, "the diagonal")
    (points,) = re.findall(r'points="([^"]*)"', svg)
    column_of = {number: point.split(",")[0] for number, point in enumerate(points.split())}
    written = re.findall(r'<text x="([0-9.]+)" y="176" text-anchor="[a-z]+">([0-9]+)</text>', svg)
    assert len(written) == 6
    assert all(column_of[int(number)] == column for column, number in written)


@pytest.mark.parametrize("y", [[0.0, 0.0], [-1.0, -2.0], [1e-320, 0.0], [np.inf, 1.0], [1e-10, 2e-10]])
def test_chart_of_any_values_has_a_few_lines(y: list[float]) -> None:
    assert 3 <= line_chart(np.arange(2.0), np.array(y), "values").count("<line") <= 6


def test_a_damaged_table_of_an_evaluation_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "vo.json").write_text('{"rows": [1]}')
    (tmp_path / "vo.md").write_bytes(b"# Table\xff\xfe")
    assert main(["report", str(tmp_path)]) == 2
    assert "vo.md: is damaged (" in capsys.readouterr().err


def test_an_evaluation_page_has_its_tables_and_meaning(tmp_path: Path) -> None:
    (tmp_path / "vo.json").write_text('{"rows": [1]}')
    (tmp_path / "vo.md").write_text("# Table\n\n- one < two\n\n| a | b |\n|---|--:|\n| sift | **.5** |\n")
    assert main(["report", str(tmp_path)]) == 0
    text = (tmp_path / "report.html").read_text()
    assert "<td><b>.5</b></td>" in text
    assert "<li>one &lt; two</li>" in text
    assert "with and without stability" in text


def test_a_run_without_any_pose_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = tmp_path / "still"
    images.mkdir()
    picture = np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)
    for number in range(5):
        cv2.imwrite(str(images / f"{number}.png"), picture)
    out = tmp_path / "out"
    assert main(["run", str(images), "-o", str(out), "--fov", "60", "--frontend", "orb", "--report"]) == 3
    text = (out / "report.html").read_text()
    assert "No frame has a pose" in text
    assert 'id="frame-slider"' in text
    assert 'id="scene"' not in text
    assert main(["show", "map", str(out)]) == 2
    assert "no map to draw" in capsys.readouterr().err


def test_a_folder_without_results_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert "has no results" in capsys.readouterr().err
    assert not (tmp_path / "report.html").exists()


def test_a_label_store_has_a_page_with_what_failed_and_why(finished_run: Path, tmp_path: Path) -> None:
    walk, still = finished_run.parent / "walk", tmp_path / "still"
    still.mkdir()
    for number in range(12):
        shutil.copy(walk / "000000.png", still / f"{number:06d}.png")
    shutil.copy(walk / "camera.yaml", still)
    labels = tmp_path / "labels"
    main(["label", str(walk), str(still), "-o", str(labels), "--frontend", "orb", "--max-keypoints", "400"])
    assert main(["report", str(labels)]) == 0
    text = (labels / "report.html").read_text()
    assert "1 of 2" in text
    assert "still has no labels" in text
    assert text.count("data:image/png") == 2  # the map from above, and the same for a telephone
    assert "Withheld: it had a label" in text
    assert main(["report", str(labels / "walk"), "-o", str(tmp_path / "one.html")]) == 0
    assert main(["report", str(labels), "--palette", "colour-blind"]) == 0
    pictures = re.compile(r"data:image/png[^\"]*")
    assert set(pictures.findall((labels / "report.html").read_text())).isdisjoint(pictures.findall(text))


def test_the_place_of_a_recording_is_refused_where_there_is_no_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "vo.json").write_text('{"rows": [1]}')
    (tmp_path / "vo.md").write_text("# Table\n")
    assert main(["report", str(tmp_path), "--sequence", "walk"]) == 2
    assert "--sequence walk: belongs to the folder of a run" in capsys.readouterr().err


def with_poses(finished: Path, folder: Path, kept: list[int]) -> Path:
    """A copy of a run in which only these frames have a pose."""
    shutil.copytree(finished, folder)
    lines = (folder / "trajectory.txt").read_text().splitlines(keepends=True)
    comments, poses = ([line for line in lines if line.startswith("#") == is_one] for is_one in (True, False))
    (folder / "trajectory.txt").write_text("".join([*comments, *(poses[number] for number in kept)]))
    content = json.loads((folder / "run.json").read_text())
    lost = [number for number in range(content["frames"]["processed"]) if number not in kept]
    content["frames"].update(tracked=len(kept), lost=len(lost), lost_frames=lost)
    (folder / "run.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("kept", [[5], [5, 6], [5, 9]])
def test_a_run_with_one_or_two_poses_has_a_map_and_a_page(finished_run: Path, tmp_path: Path, kept: list[int]) -> None:
    run = with_poses(finished_run, tmp_path / "run", kept)
    assert main(["show", "map", str(run)]) == 0
    assert main(["report", str(run)]) == 0
    assert f"{len(kept)} of 30" in (run / "report.html").read_text()


def test_a_run_without_frames_is_one_line(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As one that was interrupted before its first."""
    run = with_poses(finished_run, tmp_path / "run", [])
    content = json.loads((run / "run.json").read_text())
    content["frames"].update(processed=0, tracked=0, lost=0, lost_frames=[], source_index=[])
    content["segments"] = []
    (run / "run.json").write_text(json.dumps(content))
    for words in (["tracks", "--frames", "all"], ["labels"], ["residuals", "--video"]):
        assert main(["show", words[0], str(run), *words[1:]]) == 2
        assert capsys.readouterr().err == f"improvo: {run}: has no frames to draw\n"
    assert main(["report", str(run)]) == 0


def test_a_wide_table_and_the_map_fit_on_paper(page: Path, tmp_path: Path, browser: Any) -> None:
    share = Measure("share", "of right matches")
    rounds = [Round(name, {"share": 0.5}) for name in ("before", "round 1")]
    header = ["right matches", *(f"{gap} frames ({gap / 30:.1f} s)" for gap in (6, 12, 18, 24))]
    rows = [["round 1, share, 8 px", *["+0.1 % (-0.3 to +0.4)"] * 4]]
    write_improvement_page(tmp_path / "wide.html", "Improvement", "", [share], rounds, gains=[header, *rows])
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    paper = {"width": 718, "height": 1000, "deviceScaleFactor": 1, "mobile": False}  # A4 without its margins
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", paper)
    browser.get((tmp_path / "wide.html").as_uri())
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 718
    browser.get(page.as_uri())
    assert browser.execute_script("return document.getElementById('scene').clientHeight") < 700


def test_improvement_is_told_with_its_setbacks(tmp_path: Path) -> None:
    measures = [
        Measure("success", "share of pairs", digits=2),
        Measure("error", "pixels", larger_is_better=False, digits=2),
    ]
    picture = tmp_path / "matches.png"
    write_png(picture, np.zeros((8, 8, 3), np.uint8))
    drawn = ((picture, "matches of two frames"),)
    rounds = [
        Round("before", {"success": 0.61, "error": 0.50}, {"stable": 1200}, {"label": 3.0}, drawn),
        Round("round 1", {"success": 0.70, "error": 0.47}, {"stable": 1500, "unstable": 90}),
        Round("round 2", {"success": 0.74, "error": 0.58}, pictures=drawn),
    ]
    write_improvement_page(tmp_path / "page.html", "Improvement", "superpoint on <one> video", measures, rounds)
    text = (tmp_path / "page.html").read_text()
    assert "0.61 → 0.74" in text
    assert "<b>0.74</b>" in text
    assert "<b>0.47</b>" in text
    assert "<b>0.58</b>" not in text
    assert text.count("share of pairs") == 1
    assert "Worse than before: error, 0.50 → 0.58." in text
    assert "Worse than before: success" not in text
    assert text.count("<polyline") == 2
    pair = text[text.index('<div class="pair">') :]
    assert pair.index("before: matches") < pair.index("round 2: matches") < pair.index("</div>")
    assert "&lt;one&gt;" in text
    write_improvement_page(tmp_path / "none.html", "Improvement", "", measures, rounds, best=0)
    none = (tmp_path / "none.html").read_text()
    assert "round 2, not kept: matches" in none
    assert "Nothing: the weights are those at the start." in none
    assert "<h2>Labels" in none
    unlabelled = [replace(entry, labels={}) for entry in rounds]
    write_improvement_page(tmp_path / "held.html", "Improvement", "", measures, unlabelled)
    assert "<h2>Labels" not in (tmp_path / "held.html").read_text()


def test_what_the_page_shows_as_equal_is_no_setback(tmp_path: Path) -> None:
    measures = [Measure("length", "frames", digits=2), Measure("share", "of matches", digits=2)]
    rounds = [
        Round("before", {"length": 4.963, "share": 0.514}),
        Round("round 1", {"length": 4.957, "share": 0.506}),
    ]
    write_improvement_page(tmp_path / "page.html", "Improvement", "", measures, rounds)
    text = (tmp_path / "page.html").read_text()
    assert "Worse than before" not in text
    write_improvement_page(
        tmp_path / "less.html", "Improvement", "", measures, [rounds[0], Round("r", {"length": 4.95})]
    )
    assert "Worse than before: length, 4.96 → 4.95." in (tmp_path / "less.html").read_text()
