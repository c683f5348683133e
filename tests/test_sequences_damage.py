"""Damaged and lying recordings: one-line errors or counted skips, in bounded time and memory."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import ros_encoders
import sequence_encoders as encoders
from improvo.errors import ImprovoError, InputError
from improvo.sequences import open_sequence
from sequence_builders import CAMERA, depths, images, poses, write_images
from sequence_encoders import Scene

COUNT = 5


def scene() -> Scene:
    return Scene(CAMERA, 10.0 + np.arange(COUNT) * 0.25, images(COUNT), depths(COUNT), poses(COUNT))


def refused(path: Path, **settings: object) -> str:
    with pytest.raises(ImprovoError) as error:
        open_sequence(path, **settings)
    message = str(error.value)
    assert "\n" not in message
    return message


def outcome(path: Path) -> str:
    """What became of a damaged recording that is read to its end, depth and truth included."""
    try:
        sequence = open_sequence(path, camera="90,91,47,36.5")
        frames = list(sequence)
        assert len(frames) + len(sequence.skipped) == len(sequence)
        for i in range(len(sequence)):
            sequence.depth(i)
        truth = sequence.ground_truth
        assert truth is None or len(truth) == len(sequence)
    except InputError as error:
        return "error" if "\n" not in str(error) else f"several lines: {error}"
    return "frames"


WRITERS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "sens": ("s.sens", lambda path: encoders.write_sens(path, scene())),
    "ros1": ("s.bag", lambda path: ros_encoders.write_bag(path, scene(), 1)),
    "ros2": ("s/s.db3", lambda path: ros_encoders.write_bag(path.parent, scene(), 2) / "s.db3"),
    "mcap": ("s/s.mcap", lambda path: ros_encoders.write_bag(path.parent, scene(), 2, storage="mcap") / "s.mcap"),
    "record3d": ("s.r3d", lambda path: encoders.write_r3d(path, scene())),
    "nerfstudio": ("s/transforms.json", lambda path: encoders.write_transforms(path.parent, scene()) / path.name),
}


@pytest.mark.parametrize("name", WRITERS)
def test_cut_at_any_byte(tmp_path: Path, name: str) -> None:
    file, write = WRITERS[name]
    path = write(tmp_path / file)
    data = path.read_bytes()
    whole = path.parent if file.startswith("s/") else path
    assert outcome(whole) == "frames"
    for length in np.linspace(0, len(data) - 1, 16).astype(int):
        path.write_bytes(data[:length])
        assert outcome(whole) in ("error", "frames"), length


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_bytes(tmp_path: Path, name: str) -> None:
    file, write = WRITERS[name]
    path = write(tmp_path / file)
    data = path.read_bytes()
    whole = path.parent if file.startswith("s/") else path
    random = np.random.default_rng(4)
    for trial in range(16):
        damaged = bytearray(data)
        # half of the damage goes where the headers are
        reach = len(data) if trial % 2 else min(len(data), 2000)
        for position in random.integers(0, reach, 12):
            damaged[position] = int(random.integers(0, 256))
        path.write_bytes(damaged)
        assert outcome(whole) in ("error", "frames"), trial


def test_sens_that_is_cut_short_says_how_many_frames_there_are(tmp_path: Path) -> None:
    path = encoders.write_sens(tmp_path / "s.sens", scene())
    path.write_bytes(path.read_bytes()[:-2000])
    sequence = open_sequence(path)
    assert len(list(sequence)) == len(sequence) < COUNT
    assert any(f"{len(sequence)} of {COUNT} frames are there" in note for note in sequence.notes)


def test_sens_header_that_lies_about_counts_and_sizes(tmp_path: Path) -> None:
    path = encoders.write_sens(tmp_path / "s.sens", scene(), claimed=10**12)
    assert len(list(open_sequence(path))) == COUNT
    data = path.read_bytes()
    first = data.index(struct.pack("<fQ", 1000.0, 10**12)) + 12
    lying = bytearray(data)
    lying[first + 80 : first + 88] = struct.pack("<Q", 2**62)  # colour bytes of the first frame
    path.write_bytes(lying)
    assert "no complete frame" in refused(path)
    sizes = first - 12 - 16
    for side in (0, 2**31):
        lying = bytearray(data)
        lying[sizes : sizes + 4] = struct.pack("<I", side)
        path.write_bytes(lying)
        assert "header claims images" in refused(path)
    lying = bytearray(data)
    lying[sizes - 8 : sizes - 4] = struct.pack("<i", 7)
    path.write_bytes(lying)
    assert "colour compression 7" in refused(path)


def test_sens_of_20000_frames_opens_at_once(tmp_path: Path) -> None:
    """It hops from header to header: time is bounded, and no picture is decoded."""
    data = encoders.write_sens(tmp_path / "s.sens", scene(), claimed=20_000).read_bytes()
    first = data.index(struct.pack("<fQ", 1000.0, 20_000)) + 12
    colour, depth = struct.unpack_from("<2Q", data, first + 80)
    frame = data[first : first + 96 + colour + depth]
    frames = (frame[:64] + struct.pack("<2Q", 40_000 * i, 40_000 * i) + frame[80:] for i in range(1, 20_001))
    (tmp_path / "long.sens").write_bytes(data[:first] + b"".join(frames))
    start = time.process_time()
    sequence = open_sequence(tmp_path / "long.sens")
    assert time.process_time() - start < 1.0
    assert len(sequence) == 20_000
    assert sequence[19_999].time == pytest.approx(800.0)


def test_sens_frame_that_cannot_be_decoded_is_skipped(tmp_path: Path) -> None:
    path = encoders.write_sens(tmp_path / "s.sens", scene())
    data = bytearray(path.read_bytes())
    third = [i for i in range(len(data)) if data.startswith(b"\x89PNG", i)][2]
    data[third : third + 4] = b"JUNK"
    path.write_bytes(data)
    sequence = open_sequence(path)
    assert [frame.source_index for frame in sequence] == [0, 1, 3, 4]
    assert [skip.source for skip in sequence.skipped] == [f"{path}#2"]


def test_sens_without_time_stamps_or_with_lost_poses(tmp_path: Path) -> None:
    world_from_cam = poses(COUNT)
    world_from_cam[1] = -np.inf
    path = encoders.write_sens(tmp_path / "s.sens", replace(scene(), times=np.zeros(COUNT), poses=world_from_cam))
    sequence = open_sequence(path)
    np.testing.assert_allclose(sequence.times, np.arange(COUNT) / 30)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.valid.tolist() == [True, True, True, True, True]  # frame 1 from its neighbours
    assert sequence.recording.ground_truth is not None
    assert sequence.recording.ground_truth.valid.tolist() == [True, False, True, True, True]
    notes = "\n".join(sequence.notes)
    assert "time stamps do not increase" in notes
    assert "1 frames hold no rigid pose (1" in notes


def test_bag_without_pictures_says_what_it_has(tmp_path: Path) -> None:
    with ros_encoders.BagWriter(tmp_path / "p.bag", 1) as bag:
        bag.write("/pose", bag.pose(10**9, np.eye(4)), 10**9)
    message = refused(tmp_path / "p.bag")
    assert "no readable Image" in message
    assert "PoseStamped" in message


def test_bag_with_another_topic_than_asked_for(tmp_path: Path) -> None:
    path = ros_encoders.write_bag(tmp_path / "s.bag", scene(), 1)
    message = refused(path, topic="/nothing")
    assert "no image topic /nothing" in message
    assert "/cam/image_raw" in message


def test_bag_without_camera_info_offers_camera_and_fov(tmp_path: Path) -> None:
    with ros_encoders.BagWriter(tmp_path / "p.bag", 1) as bag:
        for i, image in enumerate(images(3)):
            bag.write("/image", bag.image((i + 1) * 10**9, image, "mono8"), (i + 1) * 10**9)
    assert "--fov" in refused(tmp_path / "p.bag")
    assert len(list(open_sequence(tmp_path / "p.bag", fov=60.0))) == 3


def test_bag_with_an_unknown_encoding_skips_those_frames(tmp_path: Path) -> None:
    with ros_encoders.BagWriter(tmp_path / "p.bag", 1) as bag:
        for i, image in enumerate(images(4)):
            encoding = "mono8" if i != 2 else "hologram"
            bag.write("/image", bag.image((i + 1) * 10**9, image, encoding), (i + 1) * 10**9)
    sequence = open_sequence(tmp_path / "p.bag", fov=60.0)
    assert [frame.source_index for frame in sequence] == [0, 1, 3]
    assert "hologram" in sequence.skipped[0].reason


def test_bag_with_unsorted_and_repeated_stamps(tmp_path: Path) -> None:
    pictures = images(5)
    with ros_encoders.BagWriter(tmp_path / "p.bag", 1) as bag:
        for i, stamp in enumerate([1, 3, 2, 3, 4]):
            bag.write("/image", bag.image(stamp * 10**9, pictures[i], "mono8"), (10 + i) * 10**9)
    sequence = open_sequence(tmp_path / "p.bag", fov=60.0)
    assert sequence.times.tolist() == [1.0, 2.0, 3.0, 4.0]
    for frame, row in zip(sequence, [0, 2, 1, 4], strict=True):
        assert (frame.image == pictures[row]).all()
    assert any("1 images repeat a time stamp" in note for note in sequence.notes)


def test_depth_that_is_not_synchronised_is_counted(tmp_path: Path) -> None:
    path = ros_encoders.write_bag(tmp_path / "near.bag", scene(), 1, depth_shift=0.01)
    assert all(open_sequence(path).depth(i) is not None for i in range(COUNT))
    sequence = open_sequence(ros_encoders.write_bag(tmp_path / "far.bag", scene(), 1, depth_shift=0.1))
    assert sequence.depth(0) is None
    assert any(f"depth for 0 of {COUNT} images" in note for note in sequence.notes)


def test_bag_file_that_is_something_else(tmp_path: Path) -> None:
    for name in ("x.bag", "x.mcap", "x.db3"):
        (tmp_path / name).write_bytes(b"hello" * 100)
        assert "cannot be read as a ROS bag" in refused(tmp_path / name)


def test_euroc_tables_with_bad_rows(tmp_path: Path) -> None:
    encoders.write_euroc(tmp_path, scene(), np.eye(4))
    table = tmp_path / "mav0" / "cam0" / "data.csv"
    rows = table.read_text().splitlines()
    table.write_text("\n".join([rows[0], rows[3], rows[1], rows[2], "garbage", "x,y.png", rows[3], rows[4]]))
    sequence = open_sequence(tmp_path)
    assert all((frame.image == image).all() for frame, image in zip(sequence, images(COUNT)[:4], strict=True))
    notes = "\n".join(sequence.notes)
    assert "2 rows are not" in notes
    assert "1 rows repeat" in notes


def test_euroc_stamps_beyond_64_bits_are_bad_rows(tmp_path: Path) -> None:
    encoders.write_euroc(tmp_path, scene(), np.eye(4))
    table = tmp_path / "mav0" / "cam0" / "data.csv"
    rows = table.read_text().splitlines()
    late = f"{2**63},{rows[2].split(',')[1]}"
    table.write_text("\n".join([*rows[:2], late, *rows[3:]]))
    sequence = open_sequence(tmp_path)
    assert len(sequence) == COUNT - 1
    assert any("1 rows are not" in note for note in sequence.notes)
    table.unlink()  # the names of the files are the stamps
    write_images(table.with_name("data"), images(1), f"{2**63}.png")
    assert len(open_sequence(tmp_path)) == COUNT


def test_euroc_with_a_transform_that_is_none(tmp_path: Path) -> None:
    encoders.write_euroc(tmp_path, scene(), np.eye(4))
    sensor = tmp_path / "mav0" / "cam0" / "sensor.yaml"
    sensor.write_text(sensor.read_text().replace("data: [1.0, 0.0", "data: [3.0, 0.0"))
    assert "T_BS is no rigid" in refused(tmp_path)
    assert "no camera `cam7`" in refused(tmp_path, topic="cam7")


def test_phone_exports_with_bad_json(tmp_path: Path) -> None:
    folder = encoders.write_transforms(tmp_path / "n", scene())
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    for broken, reason in (
        ("[]", "no JSON object"),
        ("{", "cannot be read as JSON"),
        (json.dumps(content | {"frames": []}), "lists no frames"),
        (json.dumps(content | {"camera_model": "EQUIRECTANGULAR"}), "EQUIRECTANGULAR"),
        (json.dumps(content | {"fl_x": "wide"}), "no calibration"),
    ):
        file.write_text(broken)
        assert reason in refused(folder)
    content["frames"][1]["transform_matrix"] = [[1, 2], [3]]
    content["frames"][2]["transform_matrix"] = np.full((4, 4), 2.0).tolist()
    file.write_text(json.dumps(content))
    truth = open_sequence(folder).recording.ground_truth
    assert truth is not None
    assert truth.valid.sum() == COUNT - 2


def test_polycam_images_without_camera_are_left_out_and_counted(tmp_path: Path) -> None:
    folder = encoders.write_polycam(tmp_path, scene())
    files = sorted((folder / "keyframes" / "cameras").iterdir())
    files[2].unlink()
    sequence = open_sequence(folder)
    assert len(sequence) == COUNT - 1
    assert any("1 of 5 images have no camera file" in note for note in sequence.notes)


def test_a_phone_that_claims_pictures_of_no_size_has_no_depth(tmp_path: Path) -> None:
    folder = encoders.write_polycam(tmp_path, scene())
    for file in (folder / "keyframes" / "cameras").iterdir():
        file.write_text(json.dumps(json.loads(file.read_text()) | {"width": 2e9, "height": 2e9}))
    depth = folder / "keyframes" / "depth"
    for file in depth.iterdir():
        assert cv2.imwrite(str(file), np.full((4, 4), 1000, np.uint16))
    assert open_sequence(folder, fov=60.0).depth(0) is None


def test_a_scannet_scene_with_other_pictures_beside_its_frames(tmp_path: Path) -> None:
    write_images(tmp_path, images(2), "frame-{:06d}.color.png")
    write_images(tmp_path, images(1), "abcdef{}.color.png")
    K = " ".join(map(str, np.diag([90.0, 90.0, 1.0, 1.0]).ravel()))
    (tmp_path / "_info.txt").write_text(f"m_colorWidth = 96\nm_colorHeight = 72\nm_calibrationColorIntrinsic = {K}\n")
    sequence = open_sequence(tmp_path)
    assert (sequence.format, len(sequence)) == ("scannet", 2)
