"""What newcomers and shells do to commands: refused in one line that says the remedy, or done all the same."""

from __future__ import annotations

import errno
import os
import shlex
import subprocess
import sys
import threading
import wave
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rendered_walk import write_walk

from improvo import config
from improvo.cli.commands import settings_class
from improvo.cli.config import SETTINGS
from improvo.cli.main import main
from improvo.cli.output import configured, next_step, notice, say, typed
from improvo.errors import ConfigError
from improvo.files import make_output_folder
from improvo.folder_lock import locked
from improvo.report.rerun_viewer import RerunViewer
from improvo.sequences import open_sequence
from improvo.terminal import one_line, printable

ORB = ("--frontend", "orb", "--max-keypoints", "200")


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("misuse") / "walk", frames=24, seed=3)


@pytest.fixture(scope="module")
def video(walk: Path) -> Path:
    return write_video(walk.with_name("walk.mp4"), [cv2.imread(str(path)) for path in sorted(walk.glob("*.png"))])


@pytest.fixture(scope="module")
def finished(walk: Path) -> Path:
    """A run of the walk."""
    out = walk.with_name("finished")
    assert main(["run", str(walk), "-o", str(out), *ORB, "--quiet"]) == 0
    return out


def write_video(path: Path, pictures: list[np.ndarray]) -> Path:
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (width, height))
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


def refused(words: tuple[object, ...], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that a command ends with."""
    try:
        status = main([str(word) for word in words])
    except SystemExit as end:  # of argparse
        status = int(end.code or 0)
    told = capsys.readouterr().err
    assert status == 2, told
    lines = [line for line in told.splitlines() if not line.startswith("compiling")]
    assert len(lines) == 1, told
    return lines[0]


def run_python(words: str, shell: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """A shell line in which $I stands for `improvo` with these words."""
    program = f"{shlex.quote(sys.executable)} -m improvo {words}"
    source = str(Path(__file__).parents[1] / "src")
    environment = {**os.environ, "PYTHONPATH": source, **variables}
    line = shell.replace("$I", program)
    return subprocess.run(
        ["bash", "-c", line], env=environment, capture_output=True, text=True, errors="replace", check=False
    )


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--fov", "1.1"), "--fov 1.1: must be between 4 and 179 degrees (if it is in radians: 63.0 degrees)"),
        (("--fov", "0"), "--fov 0: must be between 4 and 179 degrees"),
        (("--camera", "4.2,4.2,2.4,1.8"), "if they are in millimetres, by its width over that of the sensor"),
        (
            ("--camera", "260,260,160,120", "--fov", "60"),
            "--camera 260,260,160,120 and --fov 60: both say what the camera is",
        ),
        (("--fov", "60", "--width", "64000"), "width 64000 is more than 4 times that of its pictures"),
        (("--fov", "60", "other.mp4"), "improvo run: unrecognized arguments: other.mp4; `improvo run --help`"),
        (("--fov", "60", "--undistorted-fov", "2"), "--undistorted-fov 2: must be between 4 and 179 degrees"),
    ],
)
def test_what_is_wrong_with_the_flags(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], says: str
) -> None:
    assert says in refused(("run", video, "-o", tmp_path / "out", *words, *ORB, "--quiet"), capsys)
    assert not (tmp_path / "out").exists()


def test_unknown_words_are_told_by_the_command_and_its_part(capsys: pytest.CaptureFixture[str]) -> None:
    told = refused(("show", "map", "out", "more"), capsys)
    assert told == "improvo show map: unrecognized arguments: more; `improvo show map --help` shows the options"


def sound(path: Path) -> None:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(8000)
        file.writeframes(bytes(16000))


def sound_as_mp4(path: Path) -> None:
    handler = b"\0\0\0\x21hdlr" + bytes(8) + b"soun" + bytes(13)
    path.write_bytes(b"\0\0\0\x14ftypM4A \0\0\0\0isom" + b"\0\0\0\x29moov" + handler)


@pytest.mark.parametrize(
    ("name", "write", "says"),
    [
        ("a.wav", sound, "holds sound, and no pictures; give the video"),
        ("a.mp4", sound, "holds sound, and no pictures; give the video"),
        ("b.mp4", sound_as_mp4, "holds sound, and no pictures; give the video"),
        ("c.mp4", lambda path: path.write_text("a letter"), "is a text, not a video"),
        ("d.png", lambda path: cv2.imwrite(str(path), np.zeros((9, 9), np.uint8)), "is a single picture; give the fol"),
    ],
)
def test_what_is_no_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, write: object, says: str
) -> None:
    assert callable(write)
    write(tmp_path / name)
    told = refused(("info", tmp_path / name, "--fov", "60"), capsys)
    assert told.startswith(f"improvo: {tmp_path / name}: ")
    assert says in told


@pytest.mark.parametrize("frames", [1, 2])
def test_a_video_of_a_moment(video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], frames: int) -> None:
    short = write_video(tmp_path / "short.mp4", [frame.image for frame in colours(video)[:frames]])
    told = refused(("run", short, "-o", tmp_path / "out", "--fov", "60", *ORB, "--quiet"), capsys)
    assert told.endswith(f"has {frames} frame{'s' * (frames > 1)}; odometry needs at least 3")


def colours(path: Path) -> list[object]:
    from types import SimpleNamespace

    capture, found = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        found.append(SimpleNamespace(image=read[1]))
    return found


def test_a_phone_held_upright(video: Path, tmp_path: Path) -> None:
    """Frames lie on their side in the file, and its header says so; the pictures come out as they were seen."""
    turned = [cv2.rotate(frame.image, cv2.ROTATE_90_COUNTERCLOCKWISE) for frame in colours(video)]
    path = write_video(tmp_path / "phone.mp4", turned)
    content = bytearray(path.read_bytes())
    matrix = content.find(b"tkhd") + 8 + 36  # of the first track
    for number, value in enumerate((0, 0x10000, 0, -0x10000, 0, 0, 0, 0, 0x40000000)):
        content[matrix + 4 * number : matrix + 4 * number + 4] = value.to_bytes(4, "big", signed=True)
    path.write_bytes(content)
    seen, upright = open_sequence(path, fov=60.0), open_sequence(video, fov=60.0)
    assert seen[3].image.shape == upright[3].image.shape
    assert np.abs(seen[3].image.astype(int) - upright[3].image).mean() < 4


def test_sixteen_bits_of_grey_are_the_same_run(walk: Path, tmp_path: Path) -> None:
    deep = tmp_path / "deep"
    deep.mkdir()
    for path in sorted(walk.glob("*.png")):
        cv2.imwrite(str(deep / path.name), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16) * 257)
    (deep / "camera.yaml").write_text((walk / "camera.yaml").read_text())
    for source in (walk, deep):
        assert main(["run", str(source), "-o", str(tmp_path / f"out-{source.name}"), *ORB, "--quiet"]) == 0
    paths = [(tmp_path / f"out-{name}" / "trajectory.txt").read_bytes() for name in ("walk", "deep")]
    assert paths[0] == paths[1]


# --- outputs


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "{}", "-o", "{}"),
        ("calibrate", "{}", "--board", "9x6:25mm", "-o", "{}"),
        ("truth", "{}", "-o", "{}", "--fov", "60"),
        ("info", "{}", "--write-mask", "{}"),
        ("show", "matches", "{}", "-o", "{}", "--fov", "60"),
    ],
    ids=lambda words: "-".join(words[:2]).replace("{}", "video"),
)
def test_an_output_that_is_the_input(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    copy = tmp_path / "only-copy.mp4"
    copy.write_bytes(video.read_bytes())
    told = refused(tuple(word.format(copy) for word in words), capsys)
    assert told == f"improvo: {copy}: is what shall be read, and the output would replace it; choose another name"
    assert copy.read_bytes() == video.read_bytes()


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "{video}", "-o", "{other}"),
        ("calibrate", "--print-board", "{other}"),
        ("truth", "{video}", "-o", "{other}", "--fov", "60"),
        ("info", "{video}", "--write-mask", "{other}"),
        ("export", "onnx", "superpoint-small", "-o", "{other}"),
        ("export", "trajectory", "{run}", "-o", "{other}"),
        ("report", "{run}", "-o", "{other}"),
        ("show", "map", "{run}", "-o", "{other}"),
        ("show", "tracks", "{run}", "-o", "{other}"),
    ],
    ids=lambda words: "-".join(words[:2]).replace("{", "").replace("}", ""),
)
def test_a_file_of_another_kind_is_not_replaced(
    video: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    for command, package in (("truth", "pycolmap"), ("onnx", "onnx"), ("map", "matplotlib")):
        if command in words and find_spec(package) is None:  # imported, mujoco would choose its own way to render
            pytest.skip(f"{package} is not installed")
    other = tmp_path / "holiday.mov"
    other.write_text("precious")
    told = refused(tuple(word.format(video=video, other=other, run=finished) for word in words), capsys)
    assert told.startswith(f"improvo: {other}: exists, and is no .")
    assert other.read_text() == "precious"


def test_the_recording_of_a_run_is_not_replaced_by_a_picture_of_it(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, out = tmp_path / "only-copy.mp4", tmp_path / "out"
    copy.write_bytes(video.read_bytes())
    assert main(["run", str(copy), "-o", str(out), "--fov", "63", *ORB, "--quiet"]) == 0
    capsys.readouterr()
    told = refused(("show", "tracks", out, "-o", copy, "--quiet"), capsys)
    assert told == f"improvo: {copy}: is being read, and the output would replace it; choose another name"
    assert copy.read_bytes() == video.read_bytes()
    assert "cannot be written as '.abc'" in refused(("show", "tracks", out, "-o", tmp_path / "x.abc"), capsys)


@pytest.mark.skipif(sys.platform != "linux", reason="Linux takes any bytes as a name")
def test_an_output_whose_name_is_no_text(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = Path(os.fsdecode(os.fsencode(tmp_path) + b"/out\xff"))
    assert "the name is no text" in refused(("run", walk, "-o", out, *ORB, "--quiet"), capsys)


@pytest.mark.parametrize(
    ("output", "says"),
    [("walk/camera.yaml/out", "camera.yaml is a file, not a folder"), ("dangling", "is a link to what is not there")],
)
def test_an_output_where_no_folder_can_be(
    walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], output: str, says: str
) -> None:
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    (tmp_path / "walk").symlink_to(walk)
    assert says in refused(("run", walk, "-o", tmp_path / output, *ORB, "--quiet"), capsys)
    assert not (tmp_path / "nowhere").exists()


def test_a_live_viewer_that_is_not_there_is_told_before_any_work(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is looked for beside this Python, too: a virtual environment need not be activated."""
    pytest.importorskip("rerun")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin" / "python"))
    command = ("run", walk, "-o", tmp_path / "out", *ORB, "--quiet", "--view")
    assert "the live viewer: no program `rerun` is found" in refused(command, capsys)
    assert not (tmp_path / "out").exists()
    program = tmp_path / "bin" / "rerun"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\nexit 3\n")
    program.chmod(0o755)
    RerunViewer()


@pytest.mark.parametrize(
    "words",
    [
        ("run", "{walk}", "-o", "{out}", *ORB),
        ("label", "{walk}", "-o", "{out}", *ORB),
        ("simulate", "-o", "{out}", "--frames", "3"),
        ("export", "colmap", "{run}", "-o", "{out}"),
        ("export", "nerfstudio", "{run}", "-o", "{out}"),
        ("export", "features", "{walk}", "-o", "{out}", "--layout", "hloc", *ORB),
    ],
    ids=lambda words: "-".join(word for word in words[:2] if word.isalpha()),
)
def test_two_commands_at_once_on_one_folder(
    words: tuple[str, ...], walk: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command, package in (("simulate", "mujoco"), ("features", "h5py")):
        if command in words and find_spec(package) is None:  # imported, mujoco would choose its own way to render
            pytest.skip(f"{package} is not installed")
    out = tmp_path / "out"
    make_output_folder(out, " ".join(words[:2]) if words[0] == "export" else words[0])
    holds, done = threading.Event(), threading.Event()

    def other() -> None:
        with locked(out):
            holds.set()
            done.wait()

    thread = threading.Thread(target=other)
    thread.start()
    holds.wait()
    try:
        told = refused((*(word.format(walk=walk, out=out, run=finished) for word in words), "--quiet"), capsys)
    finally:
        done.set()
        thread.join()
    assert "is at work there" in told
    assert {path.name for path in out.iterdir()} <= {".improvo.json", "settings.yaml"}


# --- names


@pytest.mark.parametrize(
    "words",
    [
        *(["run", "demo", "-o", "SECRET/out"], ["run", "SECRET/walk.mp4", "-o", "out"], ["info", "SECRET"]),
        *(["run", "demo", "-o", "out", "--mask", "SECRET/mask.png"], ["report", "SECRET"], ["show", "map", "SECRET"]),
        *(["run", "demo", "-o", "out", "--camera", "SECRET/camera.yaml"], ["weights", "show", "SECRET/w.safetensors"]),
        *(["label", "SECRET", "-o", "out"], ["evaluate", "trajectory", "SECRET/a.txt", "demo"]),
        *(["calibrate", "demo", "-o", "SECRET/c.yaml"], ["run", "demo", "-o", "out", "--config", "SECRET/c.yaml"]),
    ],
)
def test_a_folder_that_may_not_be_looked_into_is_one_line(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Python raises where a path in such a folder is only asked whether it is there. Root may look into all of them."""
    secret, look = tmp_path / "secret", os.stat
    (secret / "deep").mkdir(parents=True)

    def stat(path: Any, *others: Any, **options: Any) -> os.stat_result:
        if isinstance(path, str | os.PathLike) and f"{secret}{os.sep}" in os.fspath(path):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return look(path, *others, **options)

    if os.geteuid() == 0:
        monkeypatch.setattr(os, "stat", stat)
    else:
        secret.chmod(0)
    monkeypatch.chdir(tmp_path)
    try:
        assert main([word.replace("SECRET", str(secret / "deep")) for word in words]) == 2
    finally:
        monkeypatch.undo()
        secret.chmod(0o700)
    message = capsys.readouterr().err
    assert message.startswith(f"improvo: {secret / 'deep'}")
    assert message.count("\n") == 1
    assert "ermission" in message


@pytest.mark.parametrize(
    ("words", "secret"),
    [
        (("info", "{video}"), "{video}"),
        (("info", "{walk}"), "{walk}"),
        (("run", "{walk}", "-o", "{new}", "--frontend", "{weights}"), "{weights}"),
        (("weights", "show", "{weights}"), "{weights}"),
        (("report", "{run}"), "{run}/run.json"),
        (("label", "{walk}", "-o", "{store}", *ORB), "{store}/settings.yaml"),
    ],
    ids=lambda words: "-".join(words[:2]).replace("{", "").replace("}", "") if isinstance(words, tuple) else "",
)
def test_what_may_not_be_read_is_neither_damaged_nor_missing(
    words: tuple[str, ...],
    secret: str,
    walk: Path,
    video: Path,
    finished: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    store, weights = tmp_path / "store", tmp_path / "own.safetensors"
    make_output_folder(store, "label")
    (store / "settings.yaml").write_text("frontend: {name: orb}\n")
    weights.write_bytes(b"not looked at")
    names = {"video": video, "walk": walk, "run": finished, "new": tmp_path / "new", "store": store, "weights": weights}
    locked, may = secret.format(**names), os.access

    def access(path: Any, mode: int) -> bool:
        return os.fspath(path) != locked and may(path, mode)

    monkeypatch.setattr(os, "access", access)  # root may read everything
    told = refused(tuple(word.format(**names) for word in words), capsys)
    assert f"{locked}: no permission to read it; choose another, or change that" in told


def test_the_next_command_can_be_pasted_whatever_the_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A recording may be called `$(rm -rf ~)`."""
    room = write_walk(tmp_path / "my $(touch pwned) room's", frames=3)
    assert main(["info", str(room)]) == 0
    command = capsys.readouterr().out.rpartition("next: `")[2].rpartition("`")[0]
    assert shlex.split(command) == ["improvo", "run", str(room), "-o", "out"]
    assert typed(Path("plain/walk.mp4")) == "plain/walk.mp4"


def test_a_name_cannot_command_the_terminal_nor_fake_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = refused(("info", tmp_path / "a\n\x1b]0;title\x07\u202egnp.mp4"), capsys)
    assert told.endswith(r"/a\n\x1b]0;title\x07\u202egnp.mp4: no such file or folder; check the path")
    for print_it in (say, notice, next_step):
        print_it("a\x1b[2Jb\nc")
    said = capsys.readouterr()
    assert "\x1b" not in said.out + said.err
    assert (printable("tab\tand\nline"), one_line("a\nb")) == ("tab\tand\nline", "a\\nb")


# --- streams


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize("shell", ["$I | head -1", "$I | true", "$I 2>&1 >/dev/null | true", "$I >&-", "$I 2>&- <&-"])
def test_work_is_done_though_nobody_listens(walk: Path, tmp_path: Path, shell: str) -> None:
    words = f"run {walk} -o {tmp_path / 'out'} {' '.join(ORB)}"
    done = run_python(words, f"{shell}; echo ${{PIPESTATUS[0]}} >&2")
    assert "Traceback" not in done.stderr
    if "2>&-" not in shell:
        assert done.stderr.splitlines()[-1] == "0", done.stderr
    assert (tmp_path / "out" / "run.json").is_file()


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_an_error_with_a_closed_stderr_has_its_status(tmp_path: Path) -> None:
    assert run_python("info nothere", "$I 2>&-; exit $?").returncode == 2


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_terminal_that_lacks_characters(walk: Path, tmp_path: Path, encoding: str) -> None:
    room = tmp_path / "über 東"
    room.symlink_to(walk)
    done = run_python(f"info {shlex.quote(str(room))}", "$I", PYTHONIOENCODING=encoding)
    assert done.returncode == 0, done.stderr
    assert r"\u6771" in done.stdout


def test_progress_that_nobody_reads_does_not_end_the_work(tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    with configured(quiet=False, as_json=False), os.fdopen(write, "w") as stream, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stderr", stream)
        notice("one")
        notice("two")


# --- units


def test_a_truth_in_millimetres_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, step in (("metres", 0.02), ("millimetres", 20.0)):
        rows = [f"{i / 30} {step * i} {step * np.sin(i / 9)} 0 0 0 0 1" for i in range(60)]
        (tmp_path / f"{name}.txt").write_text("\n".join(rows))
    words = ["evaluate", "trajectory", str(tmp_path / "metres.txt")]
    assert main([*words, str(tmp_path / "metres.txt")]) == 0
    assert "is it in metres" not in capsys.readouterr().out
    assert main([*words, str(tmp_path / "millimetres.txt")]) == 0
    assert "m/s; is it in metres and seconds?" in capsys.readouterr().out


def test_a_trajectory_without_rotations_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "zeros.txt"
    path.write_text("\n".join(f"{i / 30} {i} 0 0 0 0 0 0" for i in range(9)))
    assert "neither a pose (quaternion qx qy qz qw of length 1)" in refused(
        ("evaluate", "trajectory", path, path), capsys
    )


# --- numbers


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("info", "demo", "--samples", "0"), "samples=0: must be at least 1"),
        (("info", "demo", "--samples", "-3", "--write-mask", "new.png"), "samples=-3: must be at least 1"),
        (("evaluate", "vo", "demo", "--max-keypoints", "-1"), "max_keypoints=-1: odometry needs at least 50"),
        (("evaluate", "homography", "--synthesize", "x", "--set", "homography.confidence=2"), "confidence=2.0: is a"),
    ],
)
def test_numbers_out_of_range(words: tuple[str, ...], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert says in refused(words, capsys)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--seed", "-1"), "seed=-1: must be 0 or more, and less than 4294967296"),
        (("--seed", "99999999999999999999"), "must be 0 or more, and less than 4294967296"),
        (("--set", "odometry.tolerance=.inf"), "`odometry.tolerance`: inf is no finite number"),
        (("--set", "odometry.matching.max_distance=.nan"), "matching.max_distance=nan: must be positive"),
        (("--fps", "inf"), "`sequence.fps`: inf is no finite number"),
        (("--fps", "1e-300"), "fps 1e-300 is no number of frames a second"),
    ],
)
def test_numbers_that_mean_nothing(
    walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], says: str
) -> None:
    assert says in refused(("run", walk, "-o", tmp_path / "out", *ORB, *words, "--quiet"), capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", sorted(SETTINGS))
def test_a_seed_that_no_generator_takes_and_a_number_without_end_are_refused_everywhere(command: str) -> None:
    cls = settings_class(SETTINGS[command])
    plain = config.to_dict(cls())

    def names(values: dict[str, Any], kind: type, only: str = "", prefix: str = "") -> Iterator[str]:
        for name, value in values.items():
            if isinstance(value, dict):
                yield from names(value, kind, only, f"{prefix}{name}.")
            elif type(value) is kind and only in ("", name):
                yield f"{prefix}{name}"

    for name in names(plain, int, "seed"):
        with pytest.raises(ConfigError, match="must be 0 or more"):
            config.load(cls, None, [f"{name}=-1"])
    for name in names(plain, float):
        with pytest.raises(ConfigError):
            config.load(cls, None, [f"{name}=.inf"])


@pytest.mark.skipif(sys.platform != "linux", reason="Linux takes any bytes as a name")
def test_a_recording_whose_name_is_no_text(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Runs and pages show it with a sign in its place; tables of labels cannot hold it."""
    room = Path(os.fsdecode(os.fsencode(tmp_path) + b"/room\xff"))
    room.symlink_to(walk)
    out = tmp_path / "out"
    assert main(["run", str(room), "-o", str(out), *ORB, "--quiet"]) == 0
    assert main(["report", str(out)]) == 0
    assert "room\ufffd" in (out / "report.html").read_text(encoding="utf-8", errors="replace")
    other = Path(os.fsdecode(os.fsencode(tmp_path) + b"/hall\xff"))
    other.mkdir()
    for path in walk.iterdir():
        (other / path.name).symlink_to(path)
    capsys.readouterr()
    assert "its name is no text" in refused(("label", other, "-o", tmp_path / "labels", *ORB, "--quiet"), capsys)
