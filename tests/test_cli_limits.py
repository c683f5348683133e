"""What a machine or a stranger's results cannot give ends in one line."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_walk import write_walk

from fuzz_targets import targets
from improvo.cli.main import main
from improvo.errors import installed


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (MemoryError(), "out of memory; "),
        (MemoryError("Unable to allocate 9 GiB for an array"), "out of memory; "),
        (
            cv2.error("OpenCV(5.0.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate"),
            "out of memory; ",
        ),
        (RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory"), "out of memory; "),
        (RuntimeError("can't start new thread"), "out of memory; "),
        (OSError(errno.ENOSPC, "No space left on device", "/dev/shm/x"), "no space is left on the disk; "),
        (OSError(errno.EFBIG, "File too large"), "no space is left on the disk; "),
    ],
)
def test_what_the_machine_lacks_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, says: str
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise error

    monkeypatch.setattr("improvo.cli.info.run", fail)
    assert main(["info", str(write_walk(tmp_path / "walk", frames=2))]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith(f"improvo: {says}")


def test_an_error_of_ours_stays_a_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr("improvo.cli.info.run", fail)
    with pytest.raises(RuntimeError, match="a bug"):
        main(["info", str(write_walk(tmp_path / "walk", frames=2))])


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
def test_a_picture_that_does_not_fit_into_memory(tmp_path: Path) -> None:
    folder = tmp_path / "large"
    folder.mkdir()
    for name in ("0.png", "1.png"):
        cv2.imwrite(str(folder / name), np.zeros((9000, 9000, 3), np.uint8))
    program = f"""
import resource, sys
import cv2
import improvo.cli.info, improvo.sequences.opening
from improvo.cli.main import main
cv2.setNumThreads(1)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (100 << 20), used + (100 << 20)))
sys.exit(main(["info", {str(folder)!r}, "--fov", "60", "--quiet"]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert "Traceback" not in done.stderr
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not remove a folder that a process is in")
@pytest.mark.parametrize("words", [("run", "x", "-o", "out", "--fov", "60"), ("info", "x", "--camera", "auto")])
def test_a_working_folder_that_was_removed(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "gone"
    place.mkdir()
    monkeypatch.chdir(place)
    place.rmdir()
    try:
        assert main(words) == 2
    finally:
        monkeypatch.chdir(tmp_path)
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "removed" in told or "no such file" in told


def test_results_that_name_pictures_elsewhere_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "results"
    folder.mkdir()
    path = targets()["pose.json"].write(folder)
    content = path.read_text()
    assert main(["show", "accuracy", str(folder), "--quiet"]) == 0
    assert (folder / "pictures" / "accuracy-opencv.png").is_file()
    changed = json.loads(content.replace('"opencv"', '"../../elsewhere"'))
    path.write_text(json.dumps(changed))
    assert main(["show", "accuracy", str(folder), "--quiet"]) == 2
    assert "is no pose.json" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*elsewhere*"))


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files, as a full disk would")
@pytest.mark.parametrize(
    ("command", "needs", "room"),
    [
        ("run", "cv2", 300),
        ("run", "cv2", 6000),
        ("run", "cv2", 15_000),
        ("export features --layout hloc --no-images", "h5py", 6000),
        ("export features --layout colmap --no-images", "pycolmap", 6000),
        ("export features --layout colmap --no-images", "pycolmap", 200_000),
        ("simulate --frames 2 --size 96x64", "mujoco", 500),
    ],
)
def test_a_disk_that_is_full(tmp_path: Path, command: str, needs: str, room: int) -> None:
    if not installed(needs):
        pytest.skip(f"needs {needs}")
    walk = write_walk(tmp_path / "walk", frames=12)
    recording = [] if command.startswith("simulate") else [str(walk), "--frontend", "orb", "--max-keypoints", "400"]
    out = tmp_path / "out"
    program = f"""
import resource, sys
import improvo.cli.run, improvo.odometry.run.run_odometry
from improvo.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}))
sys.exit(main([*{command.split()!r}, *{recording!r}, "-o", {str(out)!r}, "--quiet"]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert "Traceback" not in done.stderr, done.stderr
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "cannot be written" in done.stderr or "if the disk is full" in done.stderr
    assert not [path for path in out.rglob("*") if ".partial" in path.name]
    for path in out.rglob("*.json"):
        json.loads(path.read_text())


@pytest.mark.parametrize("also", [(), ("opencv-python",)])
def test_a_second_opencv_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], also: tuple[str, ...]
) -> None:
    def version(name: str) -> str:
        if name not in ("opencv-contrib-python-headless", *also):
            raise PackageNotFoundError(name)
        return "5.0"

    monkeypatch.setattr("improvo.cli.main.version", version)
    assert main(["info", str(write_walk(tmp_path / "walk", frames=2))]) == 0
    told = "opencv-python 5.0 and opencv-contrib-python-headless 5.0 are both installed" in capsys.readouterr().err
    assert told == bool(also)


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files, as a full disk would")
@pytest.mark.parametrize("suffix", [".mp4", ".webm", ".gif"])
def test_a_video_that_does_not_fit_on_the_disk(tmp_path: Path, suffix: str) -> None:
    """OpenCV does not say when it cannot write a frame."""
    program = f"""
import resource, sys
import numpy as np
from pathlib import Path
from improvo.errors import OutputError
from improvo.report.sheets import write_video
noise = np.random.default_rng(0)
pictures = [noise.integers(0, 255, (120, 160, 3), dtype=np.uint8) for _ in range(40)]
folder = Path({str(tmp_path)!r})
write_video(folder / "whole{suffix}", pictures, 30.0)
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
try:
    write_video(folder / "part{suffix}", pictures, 30.0)
except OutputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=True)
    assert "cannot be written" in done.stdout
    assert len(done.stdout.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == [f"whole{suffix}"]
