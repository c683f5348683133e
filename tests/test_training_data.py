"""Training data: shapes with exact corners, views, labels, pairs; and what is said about unreadable pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.cli.main import whole_parser
from improvo.cli.options import pictures_source
from improvo.errors import InputError
from improvo.simulation import bundled_sequence
from improvo.training.augmentation.views import inside, random_view, warp_points
from improvo.training.data.pictures import Pictures, Source, load_pictures
from improvo.training.data.point_labels import (
    DUSTBIN,
    IGNORED,
    Consensus,
    PointLabels,
    label_cells,
    load_labels,
    save_labels,
)
from improvo.training.data.shapes import FAMILIES, draw_shape
from improvo.training.settings import (
    AdaptationSettings,
    HomographiesSettings,
    OptimiserSettings,
    PhotometricSettings,
    ViewSettings,
)

NO_LIGHT_CHANGE = PhotometricSettings(0.0, (1.0, 1.0), (1.0, 1.0), 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_seed_fixes_the_picture_and_its_corners(family: str) -> None:
    image, corners = draw_shape(np.random.default_rng(5), family, 160, 120)
    again, corners_again = draw_shape(np.random.default_rng(5), family, 160, 120)
    other, _ = draw_shape(np.random.default_rng(6), family, 160, 120)
    assert image.shape == (120, 160)
    assert image.dtype == np.uint8
    assert np.array_equal(image, again)
    assert np.array_equal(corners, corners_again)
    assert not np.array_equal(image, other)
    assert inside(corners, 160, 120).all()
    assert (len(corners) == 0) == (family in ("ellipses", "noise"))


def test_corners_of_boards_are_where_opencv_refines_them_to() -> None:
    offsets = []
    for seed in range(30):
        image, corners = draw_shape(np.random.default_rng(seed), "checkerboard", 320, 240)
        outline = cv2.convexHull(corners)
        within = [cv2.pointPolygonTest(outline, (float(x), float(y)), True) > 8 for x, y in corners]
        inner = corners[within & inside(corners, 320, 240, margin=8)].reshape(-1, 1, 2)
        if len(inner):
            criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
            offsets.append((cv2.cornerSubPix(image, inner.copy(), (3, 3), (-1, -1), criteria) - inner)[:, 0])
    together = np.concatenate(offsets)
    assert len(together) > 200
    assert np.abs(np.median(together, axis=0)).max() < 0.2  # half a pixel off would show a wrong convention
    assert np.median(np.linalg.norm(together, axis=1)) < 0.3


def test_a_cube_shows_seven_corners() -> None:
    for seed in range(8):
        _, corners = draw_shape(np.random.default_rng(seed), "cube", 320, 240)
        assert len(corners) == 7


def test_views_look_at_the_picture_and_can_be_undone() -> None:
    rng, settings = np.random.default_rng(0), ViewSettings()
    middle = np.array([[79.5, 59.5], [0.0, 0.0], [159.0, 119.0]])
    for _ in range(300):
        H = random_view(rng, settings, (320, 240), rng.uniform((0, 0), (319, 239)))
        shown = warp_points(np.linalg.inv(H), middle)
        assert np.isfinite(shown).all()
        assert inside(shown[0], 320, 240)
        assert np.allclose(warp_points(H, shown), middle, atol=1e-3)


def test_points_beyond_the_horizon_are_nowhere() -> None:
    H = np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]])
    assert np.isnan(warp_points(H, np.array([[150.0, 10.0]]))).all()
    assert np.isfinite(warp_points(H, np.array([[50.0, 10.0]]))).all()


def test_cells_hold_the_best_point_the_dustbin_or_nothing() -> None:
    settings = AdaptationSettings(accepted=0.4, undecided=0.2)
    points = np.array([[3.2, 4.9], [6.0, 1.0], [20.0, 2.0], [28.0, 2.0]])
    agreement = np.array([0.9, 0.5, 0.3, 0.1], np.float32)
    visible = np.ones((16, 40), bool)
    visible[8:, :9] = False  # the second cell of the second row is cut
    cells = label_cells(points, agreement, visible, 40, 16, settings)
    assert cells[0, 0] == 5 * 8 + 3  # the better of two points, at its rounded pixel
    assert cells[0, 2] == IGNORED  # found too seldom to be a keypoint, too often to be none
    assert cells[0, 3] == DUSTBIN
    assert cells[1, 0] == cells[1, 1] == IGNORED  # outside the picture
    assert cells[1, 2] == DUSTBIN


def test_consensus_keeps_what_is_found_again() -> None:
    settings, rng = AdaptationSettings(views=40), np.random.default_rng(1)
    consensus, corner = Consensus(160, 120), np.array([[80.0, 61.0]])
    views = ViewSettings(width=80, height=64)
    for _ in range(settings.views):
        H = random_view(rng, views, (160, 120))
        chance = rng.uniform((0, 0), (79, 63), (3, 2))  # detections that no other view repeats
        consensus.add(np.concatenate([warp_points(H, corner), chance]), H, (80, 64), settings.border)
    labels = consensus.labels(settings)
    accepted = labels.points[labels.agreement >= settings.accepted]
    assert len(accepted) == 1
    assert np.linalg.norm(accepted[0] - corner[0]) <= 1


def test_labels_survive_their_file(tmp_path: Path) -> None:
    one = PointLabels(np.array([[1, 2], [3, 4]], np.float32), np.array([0.9, 0.5], np.float32))
    none = PointLabels(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    save_labels(tmp_path / "labels.npz", [[one, none], [one]])
    read = load_labels(tmp_path / "labels.npz", [2, 1])
    assert np.array_equal(read[0][0].points, one.points)
    assert len(read[0][1].points) == 0
    assert np.array_equal(read[1][0].agreement, one.agreement)
    with pytest.raises(InputError, match="other pictures"):
        load_labels(tmp_path / "labels.npz", [3])


def test_points_of_a_pair_show_the_same_place() -> None:
    from improvo.training.batches.homography_pairs import PairBatches

    rng = np.random.default_rng(0)
    smooth = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)).astype(np.float32), (0, 0), 6)
    picture = cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    pictures = Pictures((Source("noise", (picture,), ("noise",), 1.0),))
    labels = [[PointLabels(np.array([[150, 120]], np.float32), np.ones(1, np.float32))]]
    settings = HomographiesSettings(photometric=NO_LIGHT_CHANGE, optimiser=OptimiserSettings(batch_size=6, steps=3))
    batch = PairBatches(pictures, labels, settings)[1]
    assert batch["valid"].sum() > 300
    for pair in range(6):
        a, b = batch["images"][pair, 0].astype(np.float32), batch["images"][6 + pair, 0].astype(np.float32)
        grey_a = cv2.remap(a, batch["points_a"][pair][None], None, cv2.INTER_LINEAR)[0]
        grey_b = cv2.remap(b, batch["points_b"][pair][None], None, cv2.INTER_LINEAR)[0]
        difference = np.abs(grey_a - grey_b)[batch["valid"][pair]]
        assert difference.size == 0 or np.median(difference) < 4
    again = PairBatches(pictures, labels, settings)[1]
    assert all(np.array_equal(batch[name], again[name]) for name in batch)


def test_a_camera_that_turned_gives_exact_homographies(tmp_path: Path) -> None:
    folder = tmp_path / "turning"
    folder.mkdir()
    for index in range(2):
        cv2.imwrite(str(folder / f"{index}.png"), np.full((48, 64), 90, np.uint8))
    (folder / "camera.yaml").write_text(
        "width: 64\nheight: 48\nfx: 50\nfy: 50\ncx: 31.5\ncy: 23.5\ndistortion: [0, 0, 0, 0]\n"
    )
    half = np.radians(10) / 2  # the second camera looks 10 degrees to the right: what was ahead moves left
    (folder / "groundtruth.txt").write_text(f"0 0 0 0 0 0 0 1\n1 0 0 0 0 {np.sin(half)} 0 {np.cos(half)}\n")
    source = load_pictures([str(folder)]).sources[0]
    moved = warp_points(source.homography(0, 1), np.array([31.5, 23.5]))
    assert np.allclose(moved, [31.5 - 50 * np.tan(np.radians(10)), 23.5])


def test_unreadable_pictures_are_named_and_counted(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((40, 50), np.uint8))
    (tmp_path / "b.png").write_bytes(b"no picture")
    pictures = load_pictures([f"{tmp_path}=3"])
    assert len(pictures) == 1
    assert pictures.sources[0].weight == 3
    assert pictures.skipped == (str(tmp_path / "b.png"),)


def test_demo_is_a_source_as_it_is_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["train", "homographies", "demo", "demo=2", "photographs=3", "-o", "out"]
    sources = whole_parser().parse_args(words).sources
    assert sources == [str(bundled_sequence()), f"{bundled_sequence()}=2", "photographs=3"]
    source = load_pictures(sources[1:2]).sources[0]
    assert (len(source.pictures), source.weight) == (140, 2)
    words = ["train", "odometry", "labels", "--pictures", "demo=2", "-o", "out"]
    assert whole_parser().parse_args(words).pictures == sources[1:2]
    for name in ("demo", "demo=2"):
        (tmp_path / name).mkdir()
        assert pictures_source(name) == name


def test_folders_without_a_picture_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no pictures"):
        load_pictures([str(tmp_path)])
    (tmp_path / "b.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="none of its 1 pictures"):
        load_pictures([str(tmp_path)])
    with pytest.raises(InputError, match="does not exist"):
        load_pictures([str(tmp_path / "nowhere")])


def test_augmentation_is_seeded_and_stays_in_range() -> None:
    from improvo.training.augmentation.photometric import augment

    image = np.tile(np.arange(160, dtype=np.uint8), (120, 1))
    for seed in range(20):
        one = augment(image, np.random.default_rng(seed), PhotometricSettings())
        two = augment(image, np.random.default_rng(seed), PhotometricSettings())
        assert one.shape == image.shape
        assert one.dtype == np.uint8
        assert np.array_equal(one, two)
    unchanged = augment(image, np.random.default_rng(0), replace(NO_LIGHT_CHANGE))
    assert np.abs(unchanged.astype(int) - image).max() <= 1
