"""`improvo calibrate`: known cameras are recovered from rendered boards, and sets that cannot give one are refused."""

from __future__ import annotations

import re
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.calibration.board import Board, _black, homography_tilt, parse_board
from improvo.calibration.camera_fit import View, choose_views, find_views, fit_camera
from improvo.cli.main import main
from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import load_calibration
from improvo.geometry.se3 import rigid, so3_exp
from improvo.types import Float64, UInt8

CAMERA = Camera(640, 480, 420.0, 424.0, 312.0, 246.0, (-0.28, 0.09, 0.0004, -0.0006))
BOARD = Board(9, 6, 0.025)
_TEXELS = 40  # to a square


def board_texture(board: Board, shift: Float64 | None = None) -> UInt8:
    """The board from above with a white rim of one square, `_TEXELS` to a square."""
    columns, rows = board.squares
    picture = np.full(((rows + 2) * _TEXELS, (columns + 2) * _TEXELS), 255, np.uint8)
    scale = _TEXELS / board.square
    for x, y, size in _black(board):
        left, top = (round(v * scale) + _TEXELS for v in (x, y))
        right, bottom = (round((v + size) * scale) + _TEXELS for v in (x, y))
        picture[top:bottom, left:right] = 0
    return picture


def rays_of(camera: Camera) -> Float64:
    """(H, W, 2) undistorted X/Z, Y/Z of each pixel."""
    x, y = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    return undistorted(camera, np.stack([x, y], axis=-1))


def undistorted(camera: Camera, pixels: Float64) -> Float64:
    """Undistorted X/Z, Y/Z (..., 2) of pixels: a table of the angle for fisheye, Newton's method for Brown."""
    distorted = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.distortion_model == "fisheye":
        table = np.linspace(0, 1.45, 20001)
        radii = camera.distort(np.stack([np.tan(table), np.zeros_like(table)], axis=-1))[:, 0]
        radius = np.linalg.norm(distorted, axis=-1)
        angle = np.interp(radius, radii, table)
        return distorted * (np.tan(angle) / np.maximum(radius, 1e-12))[..., None]
    rays = distorted.copy()
    along_x, along_y = np.array([1e-6, 0.0]), np.array([0.0, 1e-6])
    for _ in range(10):
        error = distorted - camera.distort(rays)
        a = (camera.distort(rays + along_x) - camera.distort(rays)) / 1e-6
        b = (camera.distort(rays + along_y) - camera.distort(rays)) / 1e-6
        determinant = a[..., 0] * b[..., 1] - b[..., 0] * a[..., 1]
        dx = (error[..., 0] * b[..., 1] - error[..., 1] * b[..., 0]) / determinant
        dy = (error[..., 1] * a[..., 0] - error[..., 0] * a[..., 1]) / determinant
        rays = rays + np.clip(np.stack([dx, dy], axis=-1), -0.2, 0.2)
    assert np.abs(camera.distort(rays) - distorted).max() < 1e-9
    return rays


class Renderer:
    """Pictures of a board by a distorted camera: each pixel is the mean of 2x2 rays."""

    def __init__(self, camera: Camera, board: Board) -> None:
        self.camera, self.board = camera, board
        fine = camera.resized(2 * camera.width, 2 * camera.height)
        self.rays = rays_of(fine)
        self.texture = board_texture(board)

    def picture(self, cam_from_board: Float64, noise: float = 1.0, seed: int = 0) -> UInt8:
        # the board's plane z = 0 seen along each ray: X = s * ray, (board_from_cam X)_z = 0
        rotation, translation = cam_from_board[:3, :3], cam_from_board[:3, 3]
        rays = np.concatenate([self.rays, np.ones((*self.rays.shape[:2], 1))], axis=-1) @ rotation
        origin = -rotation.T @ translation
        distance = -origin[2] / rays[..., 2]
        # the board's points are its inner corners; the texture starts one square and the rim before the first
        inset = 1 if self.board.charuco else 2
        texel = (origin[:2] + distance[..., None] * rays[..., :2]) / self.board.square + inset
        texel = np.where((distance > 0)[..., None], texel * _TEXELS - 0.5, -1e4).astype(np.float32)
        shown = cv2.remap(self.texture, texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderValue=128)
        small = cv2.resize(shown, (self.camera.width, self.camera.height), interpolation=cv2.INTER_AREA)
        noisy = 20 + 0.82 * small + np.random.default_rng(seed).normal(0, noise, small.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@cache
def brown_renderer() -> Renderer:
    return Renderer(CAMERA, BOARD)


def board_poses(count: int, board: Board, tilt: float = 0.6, seed: int = 1, reach: float = 1.0) -> list[Float64]:
    """cam_from_board all over the picture, tilted to all sides."""
    random = np.random.default_rng(seed)
    centre = np.append(board.points[:, :2].mean(axis=0), 0.0)
    poses = []
    for i in range(count):
        direction = 2 * np.pi * i / count
        axis = np.array([np.cos(3 * direction), np.sin(3 * direction), random.uniform(-0.3, 0.3)])
        rotation = so3_exp(tilt * random.uniform(0.6, 1.0) * axis)
        depth = random.uniform(0.26, 0.42)
        place = reach * depth * np.array([0.45 * np.cos(direction), 0.33 * np.sin(direction)])
        poses.append(rigid(rotation, np.append(place, depth) - rotation @ centre))
    return poses


def max_undistortion_error(truth: Camera, estimate: Camera, rim: float) -> float:
    """Largest distance in pixels between where the two cameras put a pixel when its distortion is taken away.

    Over the picture without a rim (a share of its sides) that the board did not reach; each camera with its own K, so
    that it is the distortion that counts.
    """
    x, y = (np.linspace(rim, 1 - rim, 19) * side for side in (truth.width, truth.height))
    x, y = np.meshgrid(x, y)
    pixels = np.stack([x, y], axis=-1)
    sent = [undistorted(c, pixels) * [c.fx, c.fy] + [c.cx, c.cy] for c in (truth, estimate)]
    return float(np.linalg.norm(sent[0] - sent[1], axis=-1).max())


@cache
def brown_pictures() -> tuple[UInt8, ...]:
    """Twenty views of the checkerboard by `CAMERA`, for all tests that need some."""
    return tuple(brown_renderer().picture(pose, seed=i) for i, pose in enumerate(board_poses(20, BOARD)))


@pytest.mark.parametrize(
    ("camera", "board", "model"),
    [
        (CAMERA, BOARD, "brown4"),
        (replace(CAMERA, distortion=()), Board(8, 7, 0.025, charuco=True), "brown4"),
        (
            replace(CAMERA, fx=300.0, fy=301.0, distortion=(0.04, -0.015, 0.003, -0.001), distortion_model="fisheye"),
            BOARD,
            "fisheye",
        ),
    ],
    ids=["checkerboard", "charuco", "fisheye"],
)
def test_known_camera_is_recovered(camera: Camera, board: Board, model: str) -> None:
    if camera is CAMERA:
        pictures: tuple[UInt8, ...] = brown_pictures()
    else:
        renderer = Renderer(camera, board)
        pictures = tuple(renderer.picture(pose, seed=i) for i, pose in enumerate(board_poses(20, board)))
    views = find_views(board, [(str(i), picture) for i, picture in enumerate(pictures)])
    assert len(views) >= 12
    fit = fit_camera(choose_views(views, 40), (camera.width, camera.height))
    assert fit.model == model
    assert fit.camera.fx == pytest.approx(camera.fx, rel=0.002)
    assert fit.camera.fy == pytest.approx(camera.fy, rel=0.002)
    rim = 0.2 if model == "fisheye" else 0.05  # at 300 px of focal length the boards are small
    assert max_undistortion_error(camera, fit.camera, rim) < 0.3
    # the deviations are of the size of the errors
    for name in ("fx", "fy", "cx", "cy"):
        assert abs(getattr(fit.camera, name) - getattr(camera, name)) < 6 * fit.deviations[name] + 0.05
    assert fit.rms < 0.3


def test_calibrated_file_of_a_folder_of_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "board").mkdir()
    for i, picture in enumerate(brown_pictures()):
        cv2.imwrite(str(tmp_path / "board" / f"{i:03d}.png"), picture)
    (tmp_path / "board" / "900.png").write_bytes(b"broken")
    out = tmp_path / "camera.yaml"
    assert main(["calibrate", str(tmp_path / "board"), "--board", "9x6:25mm", "-o", str(out)]) == 0
    camera = load_calibration(str(out)).camera(640, 480)
    assert camera.fx == pytest.approx(CAMERA.fx, rel=0.004)
    assert cv2.imread(str(tmp_path / "camera-coverage.png")).shape == (480, 640, 3)
    printed = capsys.readouterr().out
    assert re.search(r"RMS 0\.\d+ px", printed)
    assert re.search(r"fx\s+42\d\.\d+\s+\+- 0\.\d+", printed)


def test_degenerate_sets_are_refused_in_plain_words() -> None:
    def fit(pictures: tuple[UInt8, ...]) -> str:
        views = choose_views(find_views(BOARD, [(str(i), picture) for i, picture in enumerate(pictures)]), 40)
        with pytest.raises(InputError) as error:
            fit_camera(views, (640, 480))
        return str(error.value)

    def rendered(poses: list[Float64]) -> tuple[UInt8, ...]:
        return tuple(brown_renderer().picture(pose, seed=i) for i, pose in enumerate(poses))

    assert "found in 3 different sharp views" in fit(brown_pictures()[:3])
    assert re.search("always parallel|focal length open", fit(rendered(board_poses(10, BOARD, tilt=0.0))))
    assert "covers only" in fit(rendered(board_poses(8, BOARD, reach=0.0, tilt=0.3)))
    assert "found in 0 different" in fit((np.full((480, 640), 120, np.uint8),) * 2)


def test_another_board_than_was_said_is_not_found() -> None:
    picture = brown_pictures()[0]
    assert BOARD.find(picture) is not None
    assert Board(8, 5, 0.025).find(picture) is None or Board(11, 8, 0.025).find(picture) is None


def test_views_that_repeat_each_other_count_once() -> None:
    pictures = [(str(i), brown_pictures()[0]) for i in range(8)]
    assert len(choose_views(find_views(BOARD, pictures), 40)) == 1


@pytest.mark.parametrize(
    ("text", "board"),
    [
        ("9x6:25mm", Board(9, 6, 0.025)),
        ("7x5:3cm", Board(7, 5, 0.03)),
        ("9X6:25", Board(9, 6, 0.025)),
        ("charuco:8x11:20mm", Board(8, 11, 0.02, charuco=True)),
    ],
)
def test_board_specifications(text: str, board: Board) -> None:
    parsed = parse_board(text)
    assert (parsed.columns, parsed.rows, parsed.charuco) == (board.columns, board.rows, board.charuco)
    assert parsed.square == pytest.approx(board.square)


@pytest.mark.parametrize("text", ["", "9x6", "9x6:0mm", "2x2:25mm", "9x6:25ft", "9x6:5m"])
def test_impossible_boards(text: str) -> None:
    with pytest.raises(InputError, match="--board"):
        parse_board(text)


def rectangles(pdf: bytes) -> np.ndarray:
    """x, y, width, height in millimetres of all filled rectangles of a PDF page that Matplotlib wrote."""
    streams = [zlib.decompress(s) for s in re.findall(rb"stream\n(.*?)\nendstream", pdf, re.DOTALL) if s[:1] == b"x"]
    number = rb"(-?[\d.]+) (-?[\d.]+)"
    path = re.compile(number + rb" m\n" + (number + rb" l\n") * 3 + rb"h")
    found = []
    for stream in streams:
        for match in path.findall(stream):
            x, y = (np.array([float(v) for v in match[k::2]]) * 25.4 / 72 for k in (0, 1))
            found.append([x.min(), y.min(), np.ptp(x), np.ptp(y)])
    return np.array(found)


@pytest.mark.parametrize(("spec", "side"), [("9x6:25mm", 25.0), ("charuco:7x9:22mm", 22.0)])
def test_printed_board_has_its_true_size(tmp_path: Path, spec: str, side: float) -> None:
    out = tmp_path / "board.pdf"
    assert main(["calibrate", "--print-board", str(out), "--board", spec]) == 0
    found = rectangles(out.read_bytes())
    squares = found[np.isclose(found[:, 2], side, atol=1e-3) & np.isclose(found[:, 3], side, atol=1e-3)]
    board = parse_board(spec)
    columns, rows = board.squares
    assert len(squares) == (columns * rows + 1) // 2
    np.testing.assert_allclose(np.ptp(squares[:, 0]), (columns - 1) * side, atol=1e-2)
    np.testing.assert_allclose(np.ptp(squares[:, 1]), (rows - 1) * side, atol=1e-2)


def test_the_drawn_charuco_board_is_opencvs() -> None:
    board = Board(7, 9, 0.022, charuco=True)
    ours = board_texture(board)[_TEXELS:-_TEXELS, _TEXELS:-_TEXELS]
    theirs = board.charuco_board.generateImage((7 * 280, 9 * 280), marginSize=0)
    theirs = cv2.resize(theirs, ours.shape[::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(ours.astype(float) - theirs).mean() < 4


def test_board_that_does_not_fit_and_nothing_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "--print-board", str(tmp_path / "b.pdf"), "--board", "9x6:60mm"]) == 2
    assert "does not fit on A4" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert main(["calibrate"]) == 2
    assert "--print-board" in capsys.readouterr().err


def test_real_board(shared_data: Path, tmp_path: Path) -> None:
    """`checkerboard-desk`'s own camera from its frames (its board has 9 by 6 corners)."""
    out = tmp_path / "camera.yaml"
    folder = shared_data / "checkerboard-desk"
    words = ["calibrate", str(folder), "--board", "9x6:40mm", "--samples", "40", "-o", str(out)]
    assert main(words) == 0
    published = load_calibration(str(folder / "camera.yaml")).camera(752, 480)
    ours = load_calibration(str(out)).camera(752, 480)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(ours, name) == pytest.approx(getattr(published, name), rel=0.01)


def seen_views(camera: Camera, seed: int, disturbed: bool) -> list[View]:
    """Thirty views of a board, many at the rim of the picture, with 0.15 px of noise; every tenth may be spoilt."""
    rng, board = np.random.default_rng(seed), Board(9, 6, 0.025)
    corners = board.points.astype(np.float64)
    views: list[View] = []
    while len(views) < 30:
        distance, off = rng.uniform(0.25, 0.6), np.radians(rng.uniform(0, 50 if rng.random() < 0.4 else 20))
        around = rng.uniform(0, 2 * np.pi)
        facing = so3_exp(np.array([-np.sin(around), np.cos(around), 0.0]) * off)
        turned = (corners - corners.mean(axis=0)) @ (facing @ so3_exp(rng.uniform(-0.5, 0.5, 3))).T
        in_camera = turned + distance * facing[:, 2]
        if (in_camera[:, 2] < 0.05).any():
            continue
        rays = camera.distort(in_camera[:, :2] / in_camera[:, 2:])
        pixels = rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        if (pixels < 4).any() or (pixels > (camera.width - 5, camera.height - 5)).any():
            continue
        pixels += rng.normal(0, 2.0 if disturbed and len(views) % 10 == 3 else 0.15, pixels.shape)
        found = pixels.astype(np.float32)
        pose = homography_tilt(board.points, found, (camera.width, camera.height))
        views.append(View(str(len(views)), board.points, found, 1.0, pose))
    return views


@pytest.mark.parametrize(
    ("fov", "seed", "disturbed"),
    [
        (120, 1, False),  # OpenCV's own start of the fisheye model fails
        (120, 0, True),  # likewise without the views that stand out
        (90, 2, False),  # to the simple model, it is the views at the rim that stand out
        (90, 1, True),
    ],
)
def test_a_fisheye_is_one_also_where_views_at_the_rim_make_it_hard(fov: int, seed: int, disturbed: bool) -> None:
    focal = {90: 330.0, 120: 190.0}[fov]
    camera = Camera(640, 480, focal, focal, 319.5, 239.5, (0.02, -0.005, 0.001, 0.0), "fisheye")
    fit = fit_camera(seen_views(camera, seed, disturbed), (640, 480))
    assert fit.model == "fisheye"
    assert len(fit.views) == (27 if disturbed else 30)
    assert fit.camera.fx == pytest.approx(focal, rel=0.01)
    assert fit.rms == pytest.approx(0.15 * np.sqrt(2), rel=0.05)
    assert set(fit.tried) == {"brown4", "brown5", "fisheye"}


@pytest.mark.parametrize("disturbed", [False, True])
def test_a_simple_lens_keeps_its_simple_model(disturbed: bool) -> None:
    camera = Camera(640, 480, 420.0, 421.0, 322.0, 238.0, (-0.28, 0.08, 0.0002, 0.0001))
    fit = fit_camera(seen_views(camera, 0, disturbed), (640, 480))
    assert fit.model == "brown4"
    assert fit.camera.fx == pytest.approx(420.0, rel=0.005)
