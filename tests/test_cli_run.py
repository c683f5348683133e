"""`improvo run` as a user meets it: what it leaves, and one line with the mend for every bad input."""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_walk import CAMERA, write_walk

from improvo.cli.main import main
from improvo.sequences import read_trajectory
from improvo.stability.tables import read_points, read_tracks

CAMERA_TEXT = f"{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}"


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 24 images of a textured room, with camera.yaml."""
    return write_walk(tmp_path_factory.mktemp("walk") / "images", frames=24)


@pytest.fixture(scope="module")
def finished(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of a run over it."""
    out = tmp_path_factory.mktemp("run") / "out"
    assert main(["run", str(walk), "-o", str(out), "--frontend", "orb", "--max-keypoints", "500"]) == 0
    return out


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Run a command that must fail with one line and status 2; returns the line."""
    capsys.readouterr()
    assert main(["run", *words]) == 2
    message = capsys.readouterr().err.strip()
    assert message.startswith("improvo: ")
    assert "\n" not in message
    return message


def test_run_leaves_the_documented_files(finished: Path) -> None:
    names = {path.name for path in finished.iterdir()}
    assert {"trajectory.txt", "map.ply", "tracks.parquet", "points.parquet", "run.json"} <= names
    report = json.loads((finished / "run.json").read_text())
    assert report["frames"]["processed"] == 24
    assert report["frames"]["tracked"] == 24
    assert len(report["segments"]) == 1
    assert report["configuration"]["frontend"]["name"] == "orb"
    assert len(read_trajectory(finished / "trajectory.txt")) == 24


def test_tables_hold_every_raw_track_with_its_observations(finished: Path) -> None:
    points, tracks = read_points(finished / "points.parquet"), read_tracks(finished / "tracks.parquet")
    assert set(points.track.tolist()) == set(tracks.track.tolist())
    lengths = np.bincount(tracks.track, minlength=points.track.max() + 1)
    np.testing.assert_array_equal(points.observations, lengths[points.track])
    assert (points.point >= 0).sum() > 100
    assert (points.stability == 2).sum() > 20, "no stable track in a static room"
    for track in np.unique(tracks.track)[:50]:
        frames = tracks.frame[tracks.track == track]
        np.testing.assert_array_equal(np.diff(frames), 1)


def test_the_same_run_gives_the_same_bytes(walk: Path, finished: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    assert main(["run", str(walk), "-o", str(again), "--frontend", "orb", "--max-keypoints", "500"]) == 0
    for name in ("trajectory.txt", "map.ply", "tracks.parquet", "points.parquet"):
        assert (finished / name).read_bytes() == (again / name).read_bytes(), name


def test_paper_mode_and_settings_reach_the_odometry(walk: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["--mode", "paper", "--max-frames", "6", "--set", "odometry.window.paper_poses=4", "--seed", "3"]
    assert main(["run", str(walk), "-o", str(out), "--frontend", "orb", "--max-keypoints", "200", *words]) == 0
    configuration = json.loads((out / "run.json").read_text())["configuration"]
    assert configuration["odometry"]["mode"] == "paper"
    assert configuration["odometry"]["window"]["paper_poses"] == 4
    assert configuration["odometry"]["seed"] == 3


def test_printed_settings_can_be_given_back(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "run", "--set", "frontend.name=orb", "--set", "frontend.max_keypoints=300"]) == 0
    config = tmp_path / "config.yaml"
    config.write_text(capsys.readouterr().out)
    out = tmp_path / "out"
    assert main(["run", str(walk), "-o", str(out), "--config", str(config), "--max-frames", "5"]) == 3
    configuration = json.loads((out / "run.json").read_text())["configuration"]
    assert configuration["frontend"]["name"] == "orb"
    assert configuration["frontend"]["max_keypoints"] == 300
    assert configuration["frontend"]["use_stability"] is True


def test_one_unreadable_frame_is_skipped_and_named(walk: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for path in sorted(walk.iterdir()):
        (damaged / path.name).write_bytes(path.read_bytes())
    broken = sorted(damaged.glob("*.png"))[12]
    broken.write_bytes(broken.read_bytes()[:200])
    out = tmp_path / "out"
    assert main(["run", str(damaged), "-o", str(out), "--frontend", "orb", "--max-keypoints", "500"]) == 0
    report = json.loads((out / "run.json").read_text())
    assert [Path(each["source"]).name for each in report["input"]["skipped"]] == [broken.name]
    assert report["frames"]["processed"] == 23
    assert report["frames"]["tracked"] == 23


def there_and_back(walk: Path, folder: Path) -> Path:
    """The walk again and again, 960 frames."""
    folder.mkdir()
    pictures = sorted(walk.glob("*.png"))
    for i, path in enumerate([*pictures, *reversed(pictures)] * 20):
        (folder / f"{i:06d}.png").symlink_to(path)
    (folder / "camera.yaml").write_bytes((walk / "camera.yaml").read_bytes())
    return folder


def wait_for_some_frames(out: Path, is_running: Callable[[], bool]) -> None:
    """Until a run is at work."""
    deadline = time.monotonic() + 240
    while not list(out.glob(".tracks*")) and time.monotonic() < deadline and is_running():
        time.sleep(0.05)
    time.sleep(2)


def check_partial_result(out: Path) -> None:
    """What an interrupted run leaves is valid."""
    report = json.loads((out / "run.json").read_text())
    assert report["interrupted"] is True
    assert 2 <= report["frames"]["processed"] < 960
    assert len(read_points(out / "points.parquet")) > 0
    assert not list(out.glob("*.partial*"))


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_leaves_a_valid_partial_result(walk: Path, tmp_path: Path, number: int) -> None:
    long, out = there_and_back(walk, tmp_path / "long"), tmp_path / "out"
    code = "import sys, improvo.cli.main as m, improvo.terminal as t; t.INTERVAL = 0; sys.exit(m.main())"
    command = [sys.executable, "-c", code, "run", str(long), "-o", str(out), "--frontend", "orb"]
    # a shell's background job hands SIGINT down as ignored, and Python then leaves it so
    heed_interrupts = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(
        command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, preexec_fn=heed_interrupts
    ) as process:
        wait_for_some_frames(out, lambda: process.poll() is None)
        process.send_signal(number)
        assert process.wait(timeout=120) == 130
    check_partial_result(out)


@pytest.mark.skipif(sys.platform != "linux", reason="needs a terminal that can be closed")
def test_a_terminal_that_is_closed_leaves_a_valid_partial_result(walk: Path, tmp_path: Path) -> None:
    """As when the connection to another machine breaks; the progress bar has nowhere to go then."""
    import pty

    long, out = there_and_back(walk, tmp_path / "long"), tmp_path / "out"
    child, terminal = pty.fork()
    if child == 0:
        words = ["-m", "improvo", "run", str(long), "-o", str(out), "--frontend", "orb"]
        os.execv(sys.executable, [sys.executable, *words])
    os.set_blocking(terminal, False)

    def is_running() -> bool:
        with suppress(BlockingIOError):
            os.read(terminal, 1 << 16)  # or the command waits until somebody does
        return os.waitpid(child, os.WNOHANG) == (0, 0)

    wait_for_some_frames(out, is_running)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 130
    check_partial_result(out)


class TestBadInput:
    """Each is one line that names the file and the mend, with nothing left behind."""

    def test_no_such_path(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        message = refused(capsys, str(tmp_path / "nowhere.mp4"), "-o", str(tmp_path / "out"))
        assert "nowhere.mp4" in message
        assert not (tmp_path / "out").exists()

    def test_empty_folder(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "empty").mkdir()
        assert "empty" in refused(capsys, str(tmp_path / "empty"), "-o", str(tmp_path / "out"))

    def test_unknown_layout(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "notes").mkdir()
        (tmp_path / "notes" / "todo.txt").write_text("buy milk")
        assert "--format" in refused(capsys, str(tmp_path / "notes"), "-o", str(tmp_path / "out"))

    def test_no_calibration_offers_fov(self, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        bare = tmp_path / "bare"
        bare.mkdir()
        for path in walk.glob("*.png"):
            (bare / path.name).symlink_to(path)
        message = refused(capsys, str(bare), "-o", str(tmp_path / "out"))
        assert "--fov" in message
        assert not (tmp_path / "out").exists()
        assert main(["run", str(bare), "-o", str(tmp_path / "out"), "--camera", CAMERA_TEXT, "--max-frames", "4"]) == 3

    def test_two_images_only(self, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert "2 frames" in refused(capsys, str(walk), "-o", str(tmp_path / "out"), "--max-frames", "2")
        assert not (tmp_path / "out").exists()

    def test_a_folder_that_is_not_ours(self, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "thesis.tex").write_text("precious")
        assert "did not write" in refused(capsys, str(walk), "-o", str(tmp_path / "out"))
        assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]

    @pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write everywhere")
    def test_no_permission(self, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "locked").mkdir(mode=0o500)
        assert "permission" in refused(capsys, str(walk), "-o", str(tmp_path / "locked" / "out"))

    def test_unknown_frontend(self, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert "sift" in refused(capsys, str(walk), "-o", str(tmp_path / "out"), "--frontend", "shift")

    def test_unknown_setting(self, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        message = refused(capsys, str(walk), "-o", str(tmp_path / "out"), "--set", "odometry.sede=1")
        assert "odometry.seed" in message

    def test_a_setting_of_the_wrong_type(self, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        message = refused(capsys, str(walk), "-o", str(tmp_path / "out"), "--set", "odometry.seed=many")
        assert "many" in message

    def test_calibration_for_another_size(self, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        other = tmp_path / "camera.yaml"
        text = (walk / "camera.yaml").read_text()
        other.write_text(
            text.replace(f"width: {CAMERA.width}", "width: 1280").replace(f"height: {CAMERA.height}", "height: 720")
        )
        message = refused(capsys, str(walk), "-o", str(tmp_path / "out"), "--camera", str(other))
        assert "1280x720" in message
        assert f"{CAMERA.width}x{CAMERA.height}" in message

    def test_unreadable_ground_truth(self, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        bad = tmp_path / "bad"
        bad.mkdir()
        for path in walk.iterdir():
            (bad / path.name).symlink_to(path)
        (bad / "groundtruth.txt").write_text("0 nan nan nan 0 0 0 1\n1 0 0 0 0 0 0 0\n")
        assert "groundtruth.txt" in refused(capsys, str(bad), "-o", str(tmp_path / "out"))

    def test_a_truncated_video_runs_as_far_as_it_goes(self, walk: Path, tmp_path: Path) -> None:
        video = tmp_path / "walk.avi"
        writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 30, (CAMERA.width, CAMERA.height), False)
        for path in sorted(walk.glob("*.png")):
            writer.write(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        writer.release()
        video.write_bytes(video.read_bytes()[: video.stat().st_size * 2 // 3])
        out = tmp_path / "out"
        status = main(["run", str(video), "-o", str(out), "--camera", CAMERA_TEXT, "--frontend", "orb"])
        assert status == 0
        assert 8 <= json.loads((out / "run.json").read_text())["frames"]["processed"] < 24


def test_a_run_counts_the_pictures_that_a_list_names_and_that_are_not_there(
    walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    listed = tmp_path / "listed"
    (listed / "rgb").mkdir(parents=True)
    names = [f"rgb/{row:04d}.png" for row in range(24)]
    for name, picture in zip(names[:20], sorted(walk.glob("*.png")), strict=False):
        (listed / name).write_bytes(picture.read_bytes())
    (listed / "rgb.txt").write_text("".join(f"{row / 30:.6f} {name}\n" for row, name in enumerate(names)))
    out = tmp_path / "out"
    words = ["run", str(listed), "-o", str(out), "--camera", CAMERA_TEXT, "--frontend", "orb"]
    assert main(words) == 0
    assert f"note: {listed}: 20 of 24 listed pictures are there" in capsys.readouterr().out.splitlines()
    assert json.loads((out / "run.json").read_text())["frames"]["processed"] == 20


def test_demo_is_the_bundled_recording_unless_there_is_such_a_path(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["info", "demo", "--samples", "2"]) == 0
    assert "recognised as  tum" in capsys.readouterr().out
    assert main(["run", "demo", "-o", "out", "--frontend", "orb", "--max-frames", "12", "--scale", "truth"]) == 0
    assert "12 frames" in capsys.readouterr().out
    (tmp_path / "demo").mkdir()
    assert main(["info", "demo"]) == 2
    assert "the folder is empty" in capsys.readouterr().err
