"""Names and numbers that programs trip over: refused in one line, or read as what they are."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from fuzz_targets import scene
from improvo import config
from improvo.cli.main import main
from improvo.cli.train_options import read_data_card
from improvo.continuation import SettingsRecord
from improvo.errors import ConfigError, ImprovoError, InputError, OutputError, first_line
from improvo.evaluation.homography.pairs import Scene, open_scene
from improvo.evaluation.settings import HomographySettings
from improvo.evaluation.stability.causes import TrueCauses
from improvo.evaluation.truth.reference import lacks_times
from improvo.files import check_output_folder, write_text
from improvo.geometry.camera_files import calibration_yaml, load_calibration
from improvo.geometry.colmap_model import read_colmap_model
from improvo.geometry.text_files import read_text
from improvo.geometry.trajectory_files import read_times, read_trajectory
from improvo.odometry.run.run_folder import RunFolder
from improvo.odometry.run_settings import RunSettings
from improvo.sequences import SequenceSettings, open_sequence
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.given_files import mask_content
from improvo.sequences.images import natural_key, read_image
from improvo.sequences.mask import size_of
from improvo.sequences.opening import FORMATS
from improvo.stability.tables import read_points
from improvo.untrusted.text import load_json, load_yaml, read_json_file
from sequence_builders import CAMERA, images, write_images, write_video
from sequence_encoders import write_r3d

DIGITS = "9" * 5000


def refused(call: object, *arguments: object) -> str:
    with pytest.raises(ImprovoError) as error:
        call(*arguments)  # type: ignore[operator]
    message = str(error.value)
    assert "\n" not in message
    assert len(message) < 1000
    return message


def looped(folder: Path) -> Path:
    os.symlink(folder / "b", folder / "a")
    os.symlink(folder / "a", folder / "b")
    return folder / "a"


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "x" * 5000, "loop", "loop/x.mp4", "\udcff\ud800.mp4"])
def test_a_path_that_no_system_can_look_up(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = looped(tmp_path) if name == "loop" else tmp_path / name
    if name == "loop/x.mp4":
        path = looped(tmp_path) / "x.mp4"
    for call in (
        open_sequence,
        lambda path: load_calibration(str(path)),
        read_trajectory,
        lambda p: config.load(RunSettings, p),
    ):
        refused(call, path)
    assert main(["run", str(path), "-o", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["a\0b", "x" * 300])
def test_an_output_that_no_system_can_make(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError):
        check_output_folder(tmp_path / name, "run")
    with pytest.raises((OutputError, ValueError)):
        write_text(tmp_path / name, "x")


def test_a_name_of_255_bytes_can_be_written(tmp_path: Path) -> None:
    write_text(tmp_path / ("x" * 251 + ".txt"), "y")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["y"]


def test_a_video_with_a_name_of_255_bytes_needs_no_longer_one_beside_it(tmp_path: Path) -> None:
    write_video(tmp_path / "v.avi", images(3))
    video = (tmp_path / "v.avi").rename(tmp_path / ("x" * 251 + ".avi"))  # its calibration would be x...x.yaml
    for settings in ({"fov": 60.0}, {"camera": "90,90,47,36"}, {"camera": str(tmp_path)}):
        (tmp_path / "camera.yaml").write_text(calibration_yaml(CAMERA))
        assert len(open_sequence(video, **settings)) == 3


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_names_with_odd_digits(tmp_path: Path, suffix: str) -> None:
    pictures = images(6)
    names = ["1²3", "٣", "12", "2", "9" * 240, "½"]
    write_images(tmp_path, pictures, "{}" + suffix)
    for number, name in enumerate(names):
        (tmp_path / f"{number}{suffix}").rename(tmp_path / f"x{name}{suffix}")
    (tmp_path / "camera.yaml").write_text(calibration_yaml(CAMERA))
    assert len(open_sequence(tmp_path, fps=1.0)) >= 1
    for format in FORMATS:
        with suppress(ImprovoError):  # a format that it is not
            open_sequence(tmp_path, format=format, fps=1.0)


def test_natural_order_of_any_numbers() -> None:
    names = ["a1", "a2", "a02", "a10", "a1²3", "b", "a" + DIGITS, "a" + "9" * 4000]
    ordered, otherwise = sorted(names, key=natural_key), names[::-1]
    otherwise.sort(key=natural_key)
    assert ordered == otherwise  # also of numbers that are the same
    assert ordered[:4] == ["a1", "a1²3", "a02", "a2"]
    assert ordered.index("a2") < ordered.index("a10") < ordered.index("a" + "9" * 4000) < ordered.index("a" + DIGITS)


def test_a_mask_whose_name_is_no_text(tmp_path: Path) -> None:
    with open(os.fsencode(tmp_path) + b"/\xff.png", "wb") as file:
        file.write(b"white")
    before = mask_content(SequenceSettings(mask=str(tmp_path)))
    os.rename(os.fsencode(tmp_path) + b"/\xff.png", os.fsencode(tmp_path) + b"/\xfe.png")
    assert before.startswith("sha256:")
    assert mask_content(SequenceSettings(mask=str(tmp_path))) != before


def test_a_file_whose_name_is_no_text(tmp_path: Path) -> None:
    """Linux takes any bytes; they go through the outputs and back."""
    folder = os.fsencode(tmp_path / "room") + b"\xff"
    os.mkdir(folder)
    room = Path(os.fsdecode(folder))
    for number, image in enumerate(images(3)):
        (room / f"{number}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    (room / "camera.yaml").write_text(calibration_yaml(CAMERA))
    assert len(open_sequence(room, fps=1.0)) == 3
    (room / "v.mp4").write_bytes(bytes(99))
    with pytest.raises(ImprovoError, match="rename it"):
        open_sequence(room / "v.mp4", fov=60.0)
    write_text(tmp_path / "page.html", f"of {room}")
    assert (tmp_path / "page.html").read_bytes().endswith(b"room\xff")


@pytest.mark.parametrize(
    "number", [DIGITS, "1e999", ".inf", "-.inf", ".nan", "2001-99-99", "0o9", "1_0", "[1]", "''", "~"]
)
def test_a_number_that_is_none(tmp_path: Path, number: str) -> None:
    good = calibration_yaml(CAMERA)
    for key in ("width", "fx", "cx"):
        value = next(line for line in good.splitlines() if line.startswith(f"{key}:"))
        (tmp_path / "c.yaml").write_text(good.replace(value, f"{key}: {number}"))
        if number != "1_0":
            refused(load_calibration, str(tmp_path / "c.yaml"))
    (tmp_path / "run.yaml").write_text(f"frontend:\n  max_keypoints: {number}\n")
    if number != "1_0":
        with pytest.raises(ConfigError) as error:
            config.load(RunSettings, tmp_path / "run.yaml")
        assert "\n" not in str(error.value)
        with pytest.raises(ConfigError):
            config.load(RunSettings, overrides=[f"frontend.max_keypoints={number}"])
    (tmp_path / "times.txt").write_text(f"0\n{number}\n")
    if number != "1_0":
        with pytest.raises(InputError):
            read_times(tmp_path / "times.txt")


@pytest.mark.parametrize(
    "text", ["2001-99-99", "a: 2001-99-99 25:61:61", "? [1]\n: 2", "!!int x", "!!float y", "? {a: 1}\n: 2"]
)
def test_yaml_that_python_cannot_build(text: str) -> None:
    with pytest.raises(ValueError, match=r".") as error:
        load_yaml(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", [DIGITS, "[" * 100_000, "{", "", "\ud800"])
def test_json_that_python_cannot_build(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        load_json(text)


@pytest.mark.parametrize(
    "script",
    [
        "ffconcat version 1.0\nfile {0}\n",
        "\ufeff  ffconcat version 1.0\nfile {0}\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{0}\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
        "<?xml version='1.0'?><MPD>{0}</MPD>",
        "ffconcat version 1.0\nfile {0}\n#\0",
        "hello\n",
    ],
)
@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv"])
def test_a_text_that_calls_itself_a_video(tmp_path: Path, script: str, suffix: str) -> None:
    from sequence_builders import write_video

    write_video(tmp_path / "secret.avi", images(3))
    (tmp_path / f"v{suffix}").write_text(script.replace("{0}", "secret.avi"))
    assert "not a video" in refused(lambda path: open_sequence(path, fov=60.0), tmp_path / f"v{suffix}")
    assert len(open_sequence(tmp_path / "secret.avi", fov=60.0)) == 3


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a POSIX system")
@pytest.mark.parametrize("special", ["pipe", "/dev/zero"])
def test_a_pipe_or_a_device_is_never_read(special: str, tmp_path: Path) -> None:
    """It may lie in a folder of a stranger; to open one without a writer waits forever."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "images.bin").write_bytes(bytes(8))
    picture = str(tmp_path / "1.png")
    cv2.imwrite(picture, np.zeros((64, 64), np.uint8))
    names = ("a.png", "a.txt", "a.json", "a.yaml", "a.parquet", "run.json", "simulation.json", "cameras.bin", "H_1_2")
    for name in names:
        (tmp_path / name).symlink_to(tmp_path / "pipe" if special == "pipe" else special)
    words = "is a pipe or a device, not a file"
    with pytest.raises(UnreadableFrameError, match=words):
        read_image(tmp_path / "a.png")
    assert size_of(tmp_path / "a.png") is None
    for read in (
        lambda: read_text(tmp_path / "a.txt"),
        lambda: read_json_file(tmp_path / "a.json", "mend it"),
        lambda: SettingsRecord(tmp_path / "a.yaml").read(),
        lambda: config.load(SequenceSettings, tmp_path / "a.yaml"),
        lambda: read_points(tmp_path / "a.parquet"),
        lambda: RunFolder(tmp_path),
        lambda: lacks_times(tmp_path / "a.txt"),
        lambda: TrueCauses(tmp_path),
        lambda: read_colmap_model(tmp_path),
        lambda: read_data_card(tmp_path / "a.json"),
        lambda: open_scene(Scene("a", "other", picture, ((picture, str(tmp_path / "H_1_2")),)), HomographySettings()),
    ):
        with pytest.raises(ImprovoError, match=words):
            read()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a POSIX system")
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_pipe_among_the_pictures_is_left_out_and_named(suffix: str, tmp_path: Path) -> None:
    for number in range(6):
        cv2.imwrite(str(tmp_path / f"{number:06d}{suffix}"), np.full((48, 64), 40 * number, np.uint8))
    pipe = tmp_path / f"000003{suffix}"
    pipe.unlink()
    os.mkfifo(pipe)
    sequence = open_sequence(tmp_path, fov=60.0)
    assert len(list(sequence)) == 5
    assert [(each.index, each.reason) for each in sequence.skipped] == [(3, "is a pipe or a device, not a file")]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a POSIX system")
def test_a_pipe_in_an_unpacked_phone_recording_is_left_out_and_named(tmp_path: Path) -> None:
    write_r3d(tmp_path / "s.r3d", scene(6))
    shutil.unpack_archive(tmp_path / "s.r3d", tmp_path / "s", "zip")
    picture = sorted((tmp_path / "s" / "rgbd").glob("*.png"))[3]
    picture.unlink()
    picture.symlink_to(tmp_path / "pipe")
    os.mkfifo(tmp_path / "pipe")
    sequence = open_sequence(tmp_path / "s")
    assert len(list(sequence)) == 5
    assert [(each.index, each.reason) for each in sequence.skipped] == [(3, "is a pipe or a device, not a file")]


def test_a_picture_too_narrow_for_a_field_of_view_is_named_as_that(tmp_path: Path) -> None:
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((4000, 3), 40 * number, np.uint8))
    message = refused(lambda: open_sequence(tmp_path, fov=60.0))
    assert "pictures of 3x4000 are too narrow for a field of view of 60 degrees across their width" in message
    assert "millimetres" not in message
    assert open_sequence(tmp_path, camera="500,500,1,2000").camera.fx == 500


def test_a_foreign_error_that_says_nothing_is_told_by_its_kind() -> None:
    assert first_line(EOFError()) == "EOFError"
    assert first_line(RuntimeError("\n  out of paper  \nat line 3")) == "out of paper"
