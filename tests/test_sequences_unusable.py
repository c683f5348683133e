"""Parts of recordings that cannot be used: refused with the file and the mend, or left out and told; never guessed."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import sequence_encoders as encoders
from improvo.errors import ImprovoError
from improvo.sequences import open_sequence, ros_messages
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.image_files import orientation
from improvo.sequences.video_codec import has_sound_alone, video_codec, why_unreadable
from sequence_builders import CAMERA, depths, images, poses
from sequence_encoders import Scene

COUNT = 5


def scene() -> Scene:
    return Scene(CAMERA, 10.0 + np.arange(COUNT) * 0.25, images(COUNT), depths(COUNT), poses(COUNT))


def refused(path: Path, **settings: Any) -> str:
    with pytest.raises(ImprovoError) as error:
        open_sequence(path, **settings)
    assert "\n" not in str(error.value)
    return str(error.value)


# --- Record3D


def write_record3d(folder: Path, depth: Callable[[int], bytes] | None = None) -> Path:
    """An unpacked export, whose depth is packed by zlib in place of LZFSE."""
    (folder / "rgbd").mkdir(parents=True)
    (folder / "metadata").write_text(json.dumps(encoders.record3d_metadata(scene())))
    for i, image in enumerate(images(COUNT)):
        (folder / "rgbd" / f"{i}.png").write_bytes(encoders.png(image))
        if depth is not None:
            (folder / "rgbd" / f"{i}.depth").write_bytes(depth(i))
    return folder


def test_a_record3d_export_without_its_parts(tmp_path: Path) -> None:
    whole = write_record3d(tmp_path / "whole")
    assert len(open_sequence(whole)) == COUNT
    (whole / "metadata").rename(tmp_path / "metadata")
    assert "has no metadata, so it is no Record3D export; export it again" in refused(whole, format="record3d")
    (whole / "metadata").mkdir()  # a folder in place of the file
    assert refused(whole, format="record3d").startswith(f"{whole}: ")
    (whole / "metadata").rmdir()
    (tmp_path / "metadata").rename(whole / "metadata")
    for picture in (whole / "rgbd").iterdir():
        picture.unlink()
    assert "has no images in rgbd or rgb; export it again" in refused(whole, format="record3d")
    with zipfile.ZipFile(tmp_path / "empty.r3d", "w") as archive:
        archive.writestr("readme", "")
    assert "has no metadata" in refused(tmp_path / "empty.r3d")


def test_depth_of_record3d_is_metres_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metres = np.linspace(0.5, 3.0, 48, dtype=np.float32)
    metres[7] = 0.0

    def packed(i: int) -> bytes:
        return {3: b"no such code", 4: zlib.compress(metres[:40].tobytes())}.get(i, zlib.compress(metres.tobytes()))

    folder = write_record3d(tmp_path / "phone", packed)
    monkeypatch.setattr("improvo.sequences.record3d._lzfse", lambda: None)
    without = open_sequence(folder)
    assert without.depth(0) is None
    assert "pip install 'improvo[record3d]'" in without.notes[-1]
    monkeypatch.setattr("improvo.sequences.record3d._lzfse", lambda: zlib.decompress)
    sequence = open_sequence(folder)
    found = sequence.depth(0)
    assert found is not None
    assert found.shape == (CAMERA.height, CAMERA.width)
    assert found[0, 0] == metres[0]
    assert found[-1, -1] == metres[-1]
    assert np.isnan(found).mean() == pytest.approx(1 / 48, abs=0.005)  # where it is 0
    (folder / "rgbd" / "2.depth").write_bytes(bytes(100_000))  # more than the picture can have
    (folder / "rgbd" / "1.depth").unlink()
    assert [sequence.depth(i) is None for i in range(COUNT)] == [False, True, True, True, True]


def test_record3d_without_times_or_poses_is_read_by_its_rate(tmp_path: Path) -> None:
    folder = write_record3d(tmp_path / "old")
    metadata = encoders.record3d_metadata(scene())
    for name in ("frameTimestamps", "poses", "perFrameIntrinsicCoeffs"):
        del metadata[name]
    (folder / "metadata").write_text(json.dumps({**metadata, "fps": 10}))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.times, np.arange(COUNT) / 10)
    assert sequence.ground_truth is None
    assert sequence.camera.fx == pytest.approx(CAMERA.fx)
    (folder / "metadata").write_text(json.dumps({**metadata, "fps": -1, "dw": 0, "dh": "many"}))
    np.testing.assert_allclose(open_sequence(folder).times, np.arange(COUNT) / 30)


# --- EuRoC


def write_euroc(folder: Path) -> Path:
    return encoders.write_euroc(folder, scene(), np.eye(4))


def test_a_camera_that_a_euroc_recording_does_not_have(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "mav")
    assert "has no camera `cam7`; --topic can be one of cam0" in refused(folder, topic="cam7")
    assert "has no mav0/cam0 with images, so it is no EuRoC sequence" in refused(tmp_path, format="euroc")


@pytest.mark.parametrize("matrix", ["[1, 2, 3]", "nonsense", "{data: [" + "2, " * 15 + "2]}"])
def test_a_place_of_the_camera_that_is_no_motion(tmp_path: Path, matrix: str) -> None:
    folder = write_euroc(tmp_path / "mav")
    sensor = folder / "mav0" / "cam0" / "sensor.yaml"
    lines = sensor.read_text().split("T_BS:")[0], sensor.read_text().split("rate_hz")[1]
    sensor.write_text(f"{lines[0]}T_BS: {matrix}\nrate_hz{lines[1]}")
    assert "sensor.yaml: T_BS is no rigid 4x4 motion; repair it" in refused(folder)
    sequence = open_sequence(folder, camera=f"{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}")
    assert sequence.ground_truth is None  # the poses are those of the body


def test_rows_of_a_euroc_table_that_name_no_picture(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "mav")
    table = folder / "mav0" / "cam0" / "data.csv"
    table.write_text("\n".join(["#timestamp [ns],filename", "soon,later.png", "12,", *table.read_text().split()[2:]]))
    sequence = open_sequence(folder)
    assert len(sequence) == COUNT
    assert any("data.csv: 2 rows are not `timestamp,filename` and were left out" in note for note in sequence.notes)
    table.write_text("#timestamp [ns],filename\n")
    assert "data.csv: has no row `timestamp [ns],filename`; repair it" in refused(folder)
    table.unlink()
    assert len(open_sequence(folder)) == COUNT  # the names of the files are time stamps


def test_a_camchain_gives_the_camera_where_there_is_no_sensor_file(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "mav")
    exact = open_sequence(folder)
    (folder / "mav0" / "cam0" / "sensor.yaml").unlink()
    (folder / "dso").mkdir()
    c = CAMERA
    (folder / "dso" / "camchain.yaml").write_text(
        f"cam0:\n  camera_model: pinhole\n  intrinsics: [{c.fx}, {c.fy}, {c.cx}, {c.cy}]\n  distortion_model: radtan\n"
        f"  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [{c.width}, {c.height}]\n  T_cam_imu: {np.eye(4).tolist()}\n"
    )
    sequence = open_sequence(folder)
    assert sequence.camera.fx == pytest.approx(c.fx)
    assert sequence.ground_truth is not None
    assert exact.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam, exact.ground_truth.world_from_cam)


# --- ICL-NUIM


def test_icl_pairs_in_either_order_and_lines_that_are_none(tmp_path: Path) -> None:
    folder = encoders.write_icl(tmp_path / "icl", scene())
    table = folder / "associations.txt"
    table.write_text(
        "# rgb first\n0 rgb/0.png 0 depth/0.png\n1 depth/1.png 1 rgb/1.png\nx rgb/2.png x depth/2.png\n3\n"
    )
    sequence = open_sequence(folder, camera=f"{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}")
    assert sequence.indices.tolist() == [0, 1]
    assert sequence.depth(0) is not None
    table.write_text("nothing\n")
    assert len(open_sequence(folder, fov=60.0)) == COUNT  # by the names of the files
    for picture in (folder / "rgb").iterdir():
        picture.unlink()
    assert "has no rgb images named by their frame numbers" in refused(folder, fov=60.0)


# --- EXIF


def exif(order: str, tag: int, value: int, cut: int | None = None) -> bytes:
    tiff = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HI", 42, 8)
    tiff += struct.pack(f"{order}H", 1) + struct.pack(f"{order}HHIHH", tag, 3, 1, value, 0)
    body = b"Exif\0\0" + tiff[:cut]
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(body) + 2) + body


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (exif("<", 0x0112, 6), 6),
        (exif(">", 0x0112, 8), 8),
        (exif("<", 0x0112, 9), 1),  # there are eight
        (exif("<", 0x0110, 6), 1),  # another tag
        (exif("<", 0x0112, 6, cut=12), 1),
        (exif("<", 0x0112, 6).replace(b"II", b"XX"), 1),
        (b"no picture", 1),
        (b"", 1),
    ],
)
def test_the_orientation_that_a_picture_notes(tmp_path: Path, content: bytes, expected: int) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    assert orientation(tmp_path / "a.jpg") == expected
    (tmp_path / "a.png").write_bytes(content)
    assert orientation(tmp_path / "a.png") == 1
    assert orientation(tmp_path / "missing.jpg") == 1


# --- ROS messages


def message(encoding: str, pixels: np.ndarray, **fields: Any) -> SimpleNamespace:
    height, width = pixels.shape[:2]
    step = pixels.nbytes // height
    values = {"height": height, "width": width, "step": step, "is_bigendian": 0, "data": pixels.tobytes(), **fields}
    return SimpleNamespace(encoding=encoding, **values)


def test_pictures_and_depth_of_messages() -> None:
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    np.testing.assert_array_equal(ros_messages.image(message("mono8", grey)), grey)
    rgb = np.dstack([grey, grey + 100, grey + 200])
    np.testing.assert_array_equal(ros_messages.image(message("rgb8", rgb)), rgb[..., ::-1])
    deep = (grey.astype(np.uint16) * 100).astype(">u2")
    np.testing.assert_array_equal(ros_messages.image(message("mono16", deep, is_bigendian=1)), deep)
    metres = ros_messages.depth(message("16UC1", deep.astype("<u2")))
    np.testing.assert_allclose(metres[0, 1:], deep[0, 1:] / 1000.0, rtol=1e-6)
    assert np.isnan(metres[0, 0])
    floats = grey.astype("<f4")
    np.testing.assert_array_equal(ros_messages.depth(message("32FC1", floats))[1:], floats[1:])


@pytest.mark.parametrize(
    ("read", "bad", "says"),
    [
        (ros_messages.image, message("nv12", np.zeros((6, 8), np.uint8)), "encoding 'nv12' is not known"),
        (ros_messages.image, message("32FC1", np.zeros((6, 8), "<f4")), "is no picture; choose another --topic"),
        (ros_messages.image, message("mono8", np.zeros((6, 8), np.uint8), data=b"12"), "has 2 bytes for 8x6 mono8"),
        (ros_messages.image, message("mono8", np.zeros((6, 8), np.uint8), step=3), "bytes for 8x6"),
        (ros_messages.image, message("mono8", np.zeros((6, 8), np.uint8), width=0), "bytes for 0x6"),
        (ros_messages.depth, message("rgb8", np.zeros((6, 8, 3), np.uint8)), "encoding rgb8 is no depth"),
        (
            ros_messages.depth,
            SimpleNamespace(format="png", data=encoders.png(np.zeros((6, 8), np.uint8))),
            "compressed depth 'png' is not 16 bit",
        ),
    ],
)
def test_messages_that_cannot_be_read(read: Callable[[Any], Any], bad: Any, says: str) -> None:
    with pytest.raises(UnreadableFrameError, match=says):
        read(bad)


def test_compressed_depth_has_a_header_of_its_transport() -> None:
    deep = np.full((6, 8), 1500, np.uint16)
    packed = SimpleNamespace(format="16UC1; compressedDepth png", data=bytes(12) + encoders.png(deep))
    np.testing.assert_allclose(ros_messages.depth(packed), 1.5)
    assert ros_messages.is_depth(packed, "/camera/image")
    assert ros_messages.is_depth(message("mono16", deep), "/camera/depth/image")
    assert not ros_messages.is_depth(message("mono16", deep), "/camera/infra")


def test_a_pose_that_is_no_rotation_and_a_header_that_is_cut() -> None:
    turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=2.0)
    place = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    stamped = SimpleNamespace(pose=SimpleNamespace(position=place, orientation=turn))
    assert np.isnan(ros_messages.pose(stamped)).all()
    turn.w = 1.0
    np.testing.assert_array_equal(ros_messages.pose(stamped)[:3, 3], [1.0, 2.0, 3.0])
    moved = SimpleNamespace(transform=SimpleNamespace(translation=place, rotation=turn))
    np.testing.assert_array_equal(ros_messages.pose(moved)[:3, 3], [1.0, 2.0, 3.0])
    assert ros_messages.header_stamp(b"short", ros2=True) == 0
    assert ros_messages.header_stamp(b"\0\0\0\0" + struct.pack(">II", 3, 5), ros2=True) == 3_000_000_005
    assert ros_messages.header_stamp(b"\0\1\0\0" + struct.pack("<II", 3, 5), ros2=True) == 3_000_000_005


# --- videos


@pytest.mark.parametrize(
    ("content", "codec", "says"),
    [
        (b"\0\0\0\x18ftyp" + bytes(99) + b"moov stsd" + bytes(12) + b"hvc1" + bytes(99), "HEVC (H.265)", "convert it"),
        (b"\x1aE\xdf\xa3" + bytes(9) + b"V_MPEG4/ISO/AVC" + bytes(99), "H.264", "convert it"),
        (b"\x1aE\xdf\xa3" + bytes(9) + b"V_THEORA" + bytes(99), "THEORA", "convert it"),
        (b"\0\0\0\x18ftyp" + bytes(99), None, "has no index, so the recording was cut off before its end"),
        (b"\0\0\0\x18ftypmoov" + bytes(99), None, "cannot be opened as a video"),
    ],
)
def test_why_a_video_cannot_be_read(tmp_path: Path, content: bytes, codec: str | None, says: str) -> None:
    path = tmp_path / "my $(holiday).mp4"
    path.write_bytes(content)
    assert video_codec(path) == codec
    told = why_unreadable(path)
    assert says in told
    assert codec is None or "ffmpeg -i 'my $(holiday).mp4' -c:v" in told
    assert not has_sound_alone(path)
    assert video_codec(tmp_path / "missing.mp4") is None


def test_a_codec_beyond_the_beginning_of_a_large_file_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("improvo.sequences.video_codec._SEARCHED", 100)
    path = tmp_path / "long.mp4"
    path.write_bytes(b"\0\0\0\x18ftyp" + bytes(500) + b"moov stsd" + bytes(12) + b"av01" + bytes(20))
    assert video_codec(path) == "AV1"


def test_a_page_of_a_tiff_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    for i, image in enumerate(images(COUNT)):
        cv2.imwritemulti(str(folder / f"{i}.tif"), [image, image])
    notes = open_sequence(folder, fov=60.0).notes
    assert any("0.tif holds 2 pages, and only the first is read; split it" in note for note in notes)
