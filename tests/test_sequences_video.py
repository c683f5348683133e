"""Videos: streaming, random access equal to iteration, time stamps, damage."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from improvo.errors import InputError
from improvo.geometry.camera_files import calibration_yaml
from improvo.sequences import open_sequence
from sequence_builders import CAMERA, images, write_video

COUNT = 60


@pytest.mark.parametrize(("name", "codec"), [("v.mkv", "FFV1"), ("v.avi", "HFYU"), ("v.mp4", "FFV1")])
def test_lossless_video_round_trip(tmp_path: Path, name: str, codec: str) -> None:
    write_video(tmp_path / name, images(COUNT), fps=25.0, codec=codec)
    sequence = open_sequence(tmp_path / name, fov=60.0)
    assert (sequence.format, sequence.name, len(sequence)) == ("video", "v", COUNT)
    np.testing.assert_allclose(sequence.times, np.arange(COUNT) / 25, atol=1e-3)
    for i, (frame, image) in enumerate(zip(sequence, images(COUNT), strict=True)):
        assert (frame.image == image).all()
        assert frame.source.endswith(f"{name}#{i}")


@pytest.mark.parametrize(
    ("name", "codec"), [("v.mp4", "mp4v"), ("v.webm", "VP90"), ("v.avi", "MJPG"), ("v.mpg", "MPG1"), ("v.avi", "XVID")]
)
def test_random_access_gives_the_frames_of_iteration(tmp_path: Path, name: str, codec: str) -> None:
    write_video(tmp_path / name, images(COUNT), codec=codec)
    in_order = list(open_sequence(tmp_path / name, fov=60.0))
    assert len(in_order) == COUNT
    sequence = open_sequence(tmp_path / name, fov=60.0)
    for i in np.random.default_rng(1).permutation(COUNT)[:25].tolist():
        assert (sequence[i].image == in_order[i].image).all(), i
        assert sequence[i].time == in_order[i].time
    strided = open_sequence(tmp_path / name, fov=60.0, start=3, stride=17)
    assert [frame.source_index for frame in strided] == [3, 20, 37, 54]
    assert all((frame.image == in_order[frame.source_index].image).all() for frame in strided)
    assert [frame.time for frame in strided] == [in_order[i].time for i in (3, 20, 37, 54)]


def test_iteration_decodes_each_frame_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "v.mp4", images(COUNT), codec="mp4v")
    sequence = open_sequence(tmp_path / "v.mp4", fov=60.0)
    grabs = []
    grab = type(sequence.recording)._grab  # type: ignore[attr-defined]
    monkeypatch.setattr(type(sequence.recording), "_grab", lambda self: grabs.append(1) or grab(self))
    assert len(list(sequence)) == COUNT
    assert len(grabs) <= COUNT


def test_frame_rate_and_calibration_beside_the_video(tmp_path: Path) -> None:
    write_video(tmp_path / "walk.avi", images(5), fps=25.0)
    (tmp_path / "walk.yaml").write_text(calibration_yaml(CAMERA))
    assert open_sequence(tmp_path / "walk.avi").camera == CAMERA
    np.testing.assert_allclose(open_sequence(tmp_path / "walk.avi", fps=10.0).times, np.arange(5) / 10)


def test_video_cut_short_gives_the_frames_it_has(tmp_path: Path) -> None:
    write_video(tmp_path / "whole.avi", images(COUNT))
    whole = list(open_sequence(tmp_path / "whole.avi", fov=60.0))
    data = (tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) // 2])
    sequence = open_sequence(tmp_path / "cut.avi", fov=60.0)
    frames = list(sequence)
    assert COUNT // 3 < len(frames) < 2 * COUNT // 3
    assert len(frames) + len(sequence.skipped) == len(sequence)
    undamaged = [(frame.image == whole[frame.source_index].image).all() for frame in frames]
    assert sum(undamaged) >= len(frames) - 1


def test_mp4_without_its_index_is_a_one_line_error(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", images(COUNT), codec="mp4v")
    data = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"cut.mp4: has no index, so the recording was cut off"):
        open_sequence(tmp_path / "cut.mp4", fov=60.0)


@pytest.mark.parametrize(
    ("name", "codec"), [("v.avi", "MJPG"), ("v.mkv", "FFV1"), ("v.webm", "VP90"), ("v.mp4", "mp4v")]
)
def test_damaged_bytes_never_do_worse_than_errors_and_skips(tmp_path: Path, name: str, codec: str) -> None:
    write_video(tmp_path / name, images(20), codec=codec)
    data = bytearray((tmp_path / name).read_bytes())
    random = np.random.default_rng(3)
    outcomes = []
    for trial in range(12):
        damaged = bytearray(data)
        if trial % 2:
            del damaged[int(random.integers(1, len(data))) :]
        else:
            for position in random.integers(0, len(data), 20):
                damaged[position] = int(random.integers(0, 256))
        file = tmp_path / f"{trial}{Path(name).suffix}"
        file.write_bytes(damaged)
        try:
            sequence = open_sequence(file, fov=60.0)
            frames = list(sequence)
            assert len(frames) + len(sequence.skipped) == len(sequence)
            outcomes.append("frames")
        except InputError as error:
            outcomes.append("error" if "\n" not in str(error) else "long error")
    assert "frames" in outcomes
    assert "long error" not in outcomes


def test_something_else_named_video(tmp_path: Path) -> None:
    for content in (b"", b"hello", bytes(5000)):
        (tmp_path / "v.mp4").write_bytes(content)
        with pytest.raises(InputError, match=r"v\.mp4"):
            open_sequence(tmp_path / "v.mp4", fov=60.0)


def rotated(data: bytes, degrees: int) -> bytes:
    """An MP4 whose track header says that it is to be shown turned clockwise (ISO 14496-12, `tkhd` matrix)."""
    at = data.index(b"tkhd") + 4 + 40  # version 0: 40 bytes before the matrix
    one = 1 << 16
    a, b, c, d = {90: (0, one, -one, 0), 180: (-one, 0, 0, -one), 270: (0, -one, one, 0)}[degrees]
    matrix = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    return data[:at] + matrix + data[at + 36 :]


@pytest.mark.parametrize(("degrees", "quarter_turns"), [(90, 3), (180, 2), (270, 1)])
def test_rotation_metadata_is_applied(tmp_path: Path, degrees: int, quarter_turns: int) -> None:
    write_video(tmp_path / "v.mp4", images(4), codec="FFV1")
    (tmp_path / "v.mp4").write_bytes(rotated((tmp_path / "v.mp4").read_bytes(), degrees))
    sequence = open_sequence(tmp_path / "v.mp4", fov=60.0)
    for frame, image in zip(sequence, images(4), strict=True):
        assert (frame.image == np.rot90(image, quarter_turns)).all()
    assert (sequence.camera.height, sequence.camera.width) == sequence[0].image.shape


def with_durations(data: bytes, durations: list[int]) -> bytes:
    """An MP4 of a constant rate with other sample durations (ISO 14496-12, `stts`): the boxes around it grow."""
    table = struct.pack(">II", 0, len(durations)) + b"".join(struct.pack(">II", 1, d) for d in durations)

    def rebuilt(box: bytes) -> bytes:
        kind, body = box[4:8], box[8:]
        if kind == b"stts":
            body = table
        elif kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
            body = b"".join(rebuilt(child) for child in boxes(body))
        return struct.pack(">I", 8 + len(body)) + kind + body

    return b"".join(rebuilt(box) for box in boxes(data))


def boxes(data: bytes) -> list[bytes]:
    result = []
    while data:
        size = struct.unpack(">I", data[:4])[0]
        result.append(data[:size])
        data = data[size:]
    return result


def test_variable_frame_rate_has_its_true_times(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", images(30), fps=25.0, codec="mp4v")
    in_order = list(open_sequence(tmp_path / "v.mp4", fov=60.0))
    data = (tmp_path / "v.mp4").read_bytes()
    assert data.index(b"mdat") < data.index(b"moov")  # so that growing the index moves no samples
    at = data.index(b"mdhd") + 4 + 12
    ticks = struct.unpack(">I", data[at : at + 4])[0]
    shares = np.random.default_rng(0).uniform(0.1, 1.0, 30)
    durations = [int(30 / 25 * ticks * share) for share in shares / shares.sum()]  # as long as the edit list says
    (tmp_path / "vfr.mp4").write_bytes(with_durations(data, durations))
    sequence = open_sequence(tmp_path / "vfr.mp4", fov=60.0)
    expected = np.concatenate([[0], np.cumsum(durations[:-1])]) / ticks
    np.testing.assert_allclose(sequence.times, expected, atol=2e-6)
    for i in np.random.default_rng(1).permutation(30).tolist():
        assert (sequence[i].image == in_order[i].image).all(), i


def test_a_colon_in_a_name_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "2026-09-01T12:30:00.avi", images(4))
    monkeypatch.chdir(tmp_path)
    assert len(list(open_sequence("2026-09-01T12:30:00.avi", fov=60.0))) == 4


@pytest.mark.parametrize(
    ("name", "content", "codec"),
    [
        ("a.mp4", b"ftypisom....moov" + b"stsd" + bytes(12) + b"av01" + bytes(80), "AV1"),
        ("a.mov", b"ftypqt  ....moov" + b"stsd" + bytes(12) + b"apch" + bytes(80), "ProRes"),
        ("a.mkv", b"\x1aE\xdf\xa3" + bytes(40) + b"V_MPEGH/ISO/HEVC" + bytes(80), "HEVC"),
    ],
)
def test_a_codec_that_cannot_be_decoded_is_named(tmp_path: Path, name: str, content: bytes, codec: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"{name}: its codec, {codec}.*ffmpeg -i {name}"):
        open_sequence(tmp_path / name, fov=60.0)


def test_what_is_painted_on_a_picture_in_colour_is_not_in_the_next_one(tmp_path: Path) -> None:
    write_video(tmp_path / "v.avi", images(3))
    sequence = open_sequence(tmp_path / "v.avi", fov=60.0)
    image = sequence[1].image.copy()
    sequence.colour(1)[:] = 0
    np.testing.assert_array_equal(sequence[1].image, image)
