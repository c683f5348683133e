"""Picture files as cameras and phones make them: whole ones are read whole, deep ones with what is in them."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.errors import InputError
from improvo.sequences import open_sequence
from improvo.sequences.grey_levels import stretch_of, to_8_bits
from improvo.sequences.image_files import orientation
from sequence_builders import CAMERA, images, write_images

FOV = 60.0


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def with_orientation(jpeg: bytes, value: int) -> bytes:
    """The JPEG with an EXIF segment that notes an orientation."""
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, value, 0, 0)
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def write(folder: Path, files: dict[str, bytes]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize(("low", "high"), [(0, 1023), (0, 4095), (7200, 8196), (0, 16000)])
def test_deep_pictures_use_the_range_that_the_recording_uses(tmp_path: Path, low: int, high: int) -> None:
    pictures = images(6)
    deep = [(low + p.astype(np.float64) / 255 * (high - low)).round().astype(np.uint16) for p in pictures]
    sequence = open_sequence(
        write(tmp_path / "s", {f"{i}.png": encoded(".png", d) for i, d in enumerate(deep)}), fov=FOV
    )
    for frame, picture in zip(sequence, pictures, strict=True):
        # the outermost per mille of the values is cut, so a straight line fits all but those
        a, b = np.polyfit(picture.ravel().astype(float), frame.image.ravel().astype(float), 1)
        assert a > 0.95
        assert np.abs(a * picture + b - frame.image).mean() < 2
    assert any("this range is stretched to 8 bits" in note for note in sequence.notes)
    other = open_sequence(tmp_path / "s", fov=FOV, start=3, stride=2)
    np.testing.assert_array_equal(other[0].image, sequence[3].image)  # one range, whatever is selected


def test_sixteen_full_bits_are_their_upper_eight(tmp_path: Path) -> None:
    pictures = images(3)
    files = {f"{i}.png": encoded(".png", p.astype(np.uint16) * 257) for i, p in enumerate(pictures)}
    sequence = open_sequence(write(tmp_path / "s", files), fov=FOV)
    assert all((frame.image == picture).all() for frame, picture in zip(sequence, pictures, strict=True))
    assert not any("stretched" in note for note in sequence.notes)


def test_float_pictures_and_colour_are_stretched_alike() -> None:
    picture = np.linspace(-1.0, 3.0, 3000).reshape(10, 100, 3).astype(np.float32)
    picture[0, 0] = np.nan
    stretch = stretch_of([picture])
    assert stretch is not None
    result = to_8_bits(picture, stretch)
    assert (result.dtype, result.shape) == (np.uint8, (10, 100, 3))
    assert result.min() == 0
    assert result.max() == 255


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_what_follows_the_end_of_a_picture_is_no_damage(tmp_path: Path, suffix: str) -> None:
    trailer = b"ftypmp42" + np.random.default_rng(0).bytes(5000) + b"\xff\xda\xff\xd8\xff"
    files = {f"{i}{suffix}": encoded(suffix, p) + trailer for i, p in enumerate(images(3))}
    sequence = open_sequence(write(tmp_path / "s", files), fov=FOV)
    assert len(list(sequence)) == 3
    assert not sequence.skipped


@pytest.mark.parametrize("progressive", [0, 1])
def test_jpeg_without_its_end_mark_is_read_where_it_is_whole(tmp_path: Path, progressive: int, capfd: object) -> None:
    picture = images(1)[0]
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
    assert data.endswith(b"\xff\xd9")
    files = {"0.jpg": data, "1.jpg": data[:-2], "2.jpg": data[: len(data) // 2], "3.jpg": data[:-40] + b"\0" * 900}
    sequence = open_sequence(write(tmp_path / "s", files), fov=FOV)
    frames = list(sequence)
    assert [frame.source_index for frame in frames] == [0, 1]
    np.testing.assert_array_equal(frames[0].image, frames[1].image)
    assert [skip.reason for skip in sequence.skipped] == ["the image is truncated"] * 2
    assert capfd.readouterr().err == ""  # type: ignore[attr-defined]


def test_orientation_of_all_is_applied_and_of_some_is_not(tmp_path: Path) -> None:
    jpegs = [encoded(".jpg", p) for p in images(4)]
    upright = write(tmp_path / "all", {f"{i}.jpg": with_orientation(j, 6) for i, j in enumerate(jpegs)})
    assert orientation(upright / "0.jpg") == 6
    sequence = open_sequence(upright, fov=FOV)
    assert sequence[0].image.shape == (CAMERA.width, CAMERA.height)
    mixed = write(tmp_path / "some", {f"{i}.jpg": with_orientation(j, 6 if i == 0 else 1) for i, j in enumerate(jpegs)})
    sequence = open_sequence(mixed, fov=FOV)
    assert [frame.image.shape for frame in sequence] == [(CAMERA.height, CAMERA.width)] * 4
    assert any("1 of 4 pictures note another rotation" in note for note in sequence.notes)


def test_a_missing_or_empty_picture_does_not_turn_the_others_back(tmp_path: Path) -> None:
    turned = {f"{i}.jpg": with_orientation(encoded(".jpg", p), 6) for i, p in enumerate(images(4))}
    folder = write(tmp_path / "s", {**turned, "2.jpg": b""})
    (folder / "rgb.txt").write_text("".join(f"{i}.5 {i}.jpg\n" for i in range(5)))  # there is no 4.jpg
    for format in ("images", "tum"):
        sequence = open_sequence(folder, fov=FOV, format=format)
        assert [frame.image.shape for frame in sequence] == [(CAMERA.width, CAMERA.height)] * 3
        assert not any("rotation" in note for note in sequence.notes)


@pytest.mark.parametrize(
    ("wanted", "other"),
    [
        ("{:04d}.jpg", "{:04d}_mask.png"),
        ("rgb_{:04d}.png", "depth_{:04d}.png"),
        ("left_{:04d}.png", "right_{:04d}.png"),
        ("{:04d}.jpg", "{:04d}.png"),
        ("frame{:04d}.png", "frame{:04d}_Depth.png"),
        ("l{:04d}.png", "r{:04d}.png"),
    ],
)
def test_masks_depth_and_the_other_eye_are_no_frames(tmp_path: Path, wanted: str, other: str) -> None:
    write_images(tmp_path / "s", images(4), wanted)
    write_images(tmp_path / "s", [255 - p for p in images(4)], other)
    sequence = open_sequence(tmp_path / "s", fov=FOV)
    assert [Path(frame.source).name for frame in sequence] == [wanted.format(i) for i in range(4)]
    assert any("left out" in note and "(4)" in note for note in sequence.notes)


def test_pictures_of_two_cameras_by_name_are_all_taken(tmp_path: Path) -> None:
    write_images(tmp_path / "s", images(3), "IMG_{:04d}.png")
    write_images(tmp_path / "s", images(2), "DSC_{:04d}.png")
    assert len(open_sequence(tmp_path / "s", fov=FOV)) == 5


def test_a_vignette_above_the_images_is_no_recording(tmp_path: Path) -> None:
    write_images(tmp_path / "s" / "images", images(6))
    cv2.imwrite(str(tmp_path / "s" / "vignette.png"), images(1)[0])
    (tmp_path / "s" / "camera.txt").write_text("0.9 1.2 0.5 0.5 0\n96 72\ncrop\n96 72\n")
    sequence = open_sequence(tmp_path / "s")
    assert len(sequence) == 6
    assert sequence.camera.fx == pytest.approx(0.9 * 96)


def test_colour_comes_in_the_geometry_of_the_grey_frame(tmp_path: Path) -> None:
    colour = [np.stack([p, 255 - p, p // 2], axis=2) for p in images(2)]
    write(tmp_path / "s", {f"{i}.png": encoded(".png", c) for i, c in enumerate(colour)})
    sequence = open_sequence(tmp_path / "s", fov=FOV)
    np.testing.assert_array_equal(sequence.colour(1), colour[1])
    half = open_sequence(tmp_path / "s", fov=FOV, width=48)
    assert half.colour(0).shape == (*half[0].image.shape, 3)


def test_pictures_that_nothing_reads_are_named(tmp_path: Path) -> None:
    write(tmp_path / "s", {"IMG_1.HEIC": b"x", "IMG_2.HEIC": b"x"})
    with pytest.raises(InputError, match=r"holds \.heic files, which are not read; convert them"):
        open_sequence(tmp_path / "s", fov=FOV)
