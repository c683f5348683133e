"""Masks: no keypoint where a picture is not used, from the sequence to training; and what calls for one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.cli.main import main
from improvo.errors import InputError
from improvo.frontend.decoding import NetworkMaps, decode
from improvo.frontend.masking import features_of
from improvo.frontend.registry import load_frontend
from improvo.frontend.settings import NetworkSettings
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import calibration_yaml
from improvo.sequences import open_sequence
from improvo.sequences.mask import BORDER
from improvo.sequences.opening import open_recording
from improvo.sequences.still import StillPixels, still_mask
from improvo.types import Frame, UInt8
from sequence_builders import CAMERA, images, texture, write_images

FRONTENDS = ("sift", "orb", "akaze", "surf", "superpoint-small")


def half(width: int = CAMERA.width, height: int = CAMERA.height) -> UInt8:
    """White on the left half."""
    return np.where(np.arange(width) < width // 2, np.uint8(255), np.uint8(0))[None].repeat(height, axis=0)


def recorded(folder: Path, count: int = 6, camera: Camera = CAMERA) -> Path:
    write_images(folder, images(count, camera))
    (folder / "camera.yaml").write_text(calibration_yaml(camera, fps=30.0))
    return folder


def written(path: Path, mask: UInt8) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), mask)
    return str(path)


@pytest.mark.parametrize("name", FRONTENDS)
def test_no_keypoint_is_masked_and_the_budget_goes_to_the_rest(name: str) -> None:
    if name == "surf":
        pytest.importorskip("mahotas")
    picture = texture(size=320)
    picture[:, 160:] = np.clip(3.0 * picture[:, 160:].astype(float) - 250, 0, 255)  # where the strongest are
    mask = np.zeros(picture.shape, np.bool_)
    mask[:, :150] = True
    frontend = load_frontend(name, 60)
    all_over = features_of(frontend, Frame(0, 0.0, picture, ""))
    found = features_of(frontend, Frame(0, 0.0, picture, "", mask))
    assert (all_over.keypoints[:, 0] > 150).any()
    assert (np.rint(found.keypoints[:, 0]) < 150).all()
    assert len(found) >= 59  # two of a network may move to one corner
    assert len(features_of(frontend, Frame(0, 0.0, picture, "", np.zeros_like(mask)))) == 0
    with pytest.raises(InputError, match="mask of shape"):
        frontend(picture, mask[:10])
    with pytest.raises(InputError, match=r"mask of type uint8: give truth values, such as `mask > 0`"):
        frontend(picture, 255 * mask.astype(np.uint8))


def test_a_network_drops_what_moves_onto_the_mask_and_masks_rows_of_a_batch() -> None:
    from improvo.frontend.network import load_network_frontend

    picture = texture(size=160)
    mask = np.ones(picture.shape, np.bool_)
    mask[:, ::9] = False
    frontend = load_network_frontend("superpoint-small", max_keypoints=200)
    plain, masked = frontend.batch([picture, picture], [None, mask])
    x, y = np.rint(masked.keypoints).astype(int).T
    assert mask[y, x].all()
    np.testing.assert_array_equal(plain.keypoints, frontend(picture).keypoints)


@pytest.mark.parametrize("corner_radius", [0, 5])
def test_a_centre_of_mass_is_not_on_the_mask_either(corner_radius: int) -> None:
    """Two peaks with a masked column between them: the centre of both lies on it."""
    heat = np.zeros((1, 64, 64), np.float32)
    heat[0, 32, [10, 14, 40]] = 0.5, 0.49, 0.3
    mask = np.ones((64, 64), np.bool_)
    mask[:, 12] = False
    picture = np.zeros((64, 64), np.float32)
    picture[32:, 10:12] = picture[32:, 13:15] = picture[32:, 40:] = 1.0
    maps = NetworkMaps(heat, np.ones((1, 8, 8, 4), np.float32), None)
    found = decode(maps, 0, picture, NetworkSettings(nms_radius=2, corner_radius=corner_radius), mask)
    x, y = np.rint(found.keypoints).astype(int).T
    assert len(found) > 0
    assert mask[y, x].all()
    assert len({*zip(x.tolist(), y.tolist(), strict=True)}) == len(found)


def test_a_sequence_carries_its_mask_with_a_border(tmp_path: Path) -> None:
    folder = recorded(tmp_path / "seq")
    sequence = open_sequence(folder, mask=written(tmp_path / "mask.png", half()))
    mask = sequence[0].mask
    assert mask is not None
    assert mask.shape == (72, 96)
    assert mask[:, : 48 - BORDER].all()
    assert not mask[:, 48 - BORDER :].any()
    assert all(frame.mask is not None for frame in sequence)
    assert "masked" in sequence.view
    assert open_sequence(folder)[0].mask is None


def test_a_mask_is_undistorted_cropped_and_resized_like_the_picture(tmp_path: Path) -> None:
    camera = Camera(192, 144, 150.0, 151.0, 95.0, 71.0, distortion=(-0.25, 0.05, 0.0, 0.0))
    folder = recorded(tmp_path / "seq", camera=camera)
    raw = np.full((144, 192), 255, np.uint8)
    raw[60:80, 100:130] = 0
    for number in range(6):  # the picture shows where its mask is
        written(folder / f"{number:06d}.png", raw)
    frame = open_sequence(folder, width=96, mask=written(tmp_path / "mask.png", raw))[0]
    assert frame.mask is not None
    assert frame.mask.shape == frame.image.shape
    grown = cv2.erode(frame.image, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BORDER + 1,) * 2))
    np.testing.assert_array_equal(frame.mask, grown == 255)


def test_a_folder_has_a_mask_for_each_frame_by_name_or_by_order(tmp_path: Path) -> None:
    folder = recorded(tmp_path / "seq")
    for name in ("{:06d}.png", "{:06d}.png.png", "m{}.png"):
        masks = tmp_path / name.strip(".{}")
        for number in range(6):
            mask = np.full((72, 96), 255, np.uint8)
            mask[:, : 8 * number] = 0
            written(masks / name.format(number), mask)
        widths = [
            int((~frame.mask[0]).sum()) for frame in open_sequence(folder, mask=str(masks)) if frame.mask is not None
        ]
        assert widths == [0, *(8 * number + BORDER for number in range(1, 6))]
    (tmp_path / "many" / "seq").mkdir(parents=True)
    for file in masks.iterdir():
        file.rename(tmp_path / "many" / "seq" / file.name)
    assert len(list(open_sequence(folder, mask=str(tmp_path / "many")))) == 6


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda at: written(at / "m.png", half(90, 72)), "90x72, the images of the recording are 96x72"),
        (lambda at: written(at / "m.png", np.zeros((72, 96), np.uint8)), "leaves no pixel to use"),
        (lambda at: written(at / "m.png", np.ones((72, 96), np.uint8)), "its brightest is 1 of 255"),
        (lambda at: str(at / "nothing.png"), "no such file"),
        (lambda at: (at / "empty").mkdir() or str(at / "empty"), "holds no image"),
        (lambda at: str(Path(written(at / "few" / "m.png", half())).parent), "1 masks with other names than the 6"),
        (lambda at: str(Path(written(at / "few" / "000002.png", half())).parent), "masks of 1 of 6 frames"),
        (lambda at: (at / "m.png").write_text("no image") and str(at / "m.png"), "cannot be read as a mask"),
    ],
)
@pytest.mark.parametrize("command", ["run", "label", "info"])
def test_a_mask_that_does_not_fit_is_one_line(
    tmp_path: Path, make: object, what: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recorded(tmp_path / "seq")
    out = [] if command == "info" else ["-o", str(tmp_path / "out")]
    assert main([command, str(folder), "--mask", make(tmp_path), *out]) == 2  # type: ignore[operator]
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert what in error
    assert not (tmp_path / "out" / "trajectory.txt").exists()


def test_keypoints_of_a_run_are_on_used_pixels(tmp_path: Path) -> None:
    from rendered_walk import write_walk

    from improvo.stability.tables import TRACKS_FILE, read_tracks

    walk = write_walk(tmp_path / "walk", frames=8)
    first = next(iter(open_sequence(walk))).image
    mask = written(tmp_path / "mask.png", half(first.shape[1], first.shape[0]))
    assert main(["run", str(walk), "-o", str(tmp_path / "out"), "--mask", mask, "--frontend", "orb"]) == 3
    keypoints = read_tracks(tmp_path / "out" / TRACKS_FILE).keypoints
    assert len(keypoints) > 100
    assert (np.rint(keypoints[:, 0]) < first.shape[1] // 2 - BORDER).all()


def overlaid(count: int = 20, number_changes: bool = True) -> list[UInt8]:
    """Moving pictures with a bar, a bonnet and a clock over them."""
    camera = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
    pictures = images(count, camera)
    for number, picture in enumerate(pictures):
        picture[:20] = 0
        picture[200:, 60:260] = texture(9)[:40, :200] * (0.8 + 0.2 * (number % 3) / 3)  # in changing light
        picture[30:54, 10:150] = 0
        text = f"12:03:{number if number_changes else 0:02d}"
        cv2.putText(picture, text, (14, 50), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2)
    return pictures


def test_what_never_changes_is_found(tmp_path: Path) -> None:
    still = StillPixels()
    for picture in overlaid():
        still.add(picture)
    black = still.mask() == 0
    assert black[:18].all()
    assert black[202:, 64:256].mean() > 0.97
    assert black[32:52, 14:146].mean() > 0.95
    assert black[80:180].mean() == 0
    assert still.share() == pytest.approx(black.mean(), abs=0.01)
    for plain in (images(20), [images(1)[0]] * 20, overlaid(6)):  # moves, stands still, too few
        nothing = StillPixels()
        for picture in plain:
            nothing.add(picture)
        assert nothing.share() == 0
    write_images(tmp_path / "plain", images(20))
    with pytest.raises(InputError, match="nothing was found"):
        still_mask(open_recording(tmp_path / "plain"), np.arange(20), 20)


def test_a_sky_that_touches_what_is_far_away_is_no_overlay() -> None:
    """As in a drive: the horizon stands still, trees at both sides move, and the sky touches both."""
    still = StillPixels()
    far, near = texture(9)[:16, :120], texture(size=640)
    for number in range(20):
        picture = near[:240, 8 * number : 8 * number + 320].copy()
        picture[:104, 100 - 5 * (number % 7) : 220 + 6 * (number % 5)] = 200
        picture[104:120, 100:220] = far
        still.add(picture)
    black = still.mask() == 0
    assert black[106:118, 104:216].mean() > 0.95
    assert black[:90].mean() == 0


def test_info_notices_it_writes_a_mask_and_is_content_with_that(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_images(tmp_path / "seq", overlaid())
    given = [str(tmp_path / "seq"), "--fov", "56"]
    mask = tmp_path / "masks" / "mask.png"
    assert main(["info", *given, "--write-mask", str(mask)]) == 0
    text = capsys.readouterr().out
    assert "never changes while the rest does" in text
    assert f"--mask {mask}" in text.splitlines()[-1]
    assert main(["info", *given, "--mask", str(mask)]) == 0
    assert "never changes" not in capsys.readouterr().out
    write_images(tmp_path / "plain", images(20))
    assert main(["info", str(tmp_path / "plain"), "--fov", "56", "--write-mask", str(tmp_path / "m.png")]) == 2
    assert not (tmp_path / "m.png").exists()


def test_a_mask_of_another_frame_size_names_the_frame(tmp_path: Path) -> None:
    folder = recorded(tmp_path / "seq")
    for number in range(6):
        written(tmp_path / "masks" / f"{number:06d}.png", half() if number != 3 else half(48, 36))
    with pytest.raises(InputError, match=r"000003.png: the mask is 48x36"):
        open_sequence(folder, mask=str(tmp_path / "masks"))
