"""The homography protocol on known truths."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.cli.main import main
from improvo.errors import ConfigError, InputError
from improvo.evaluation.homography.pairs import hpatches_scenes, open_scene, picture_scenes
from improvo.evaluation.homography.protocol import (
    evaluate_pair,
    homography_table,
    matching_precision,
    run_homography_protocol,
)
from improvo.evaluation.settings import HomographySettings
from improvo.evaluation.sources import LoadedFrontend
from improvo.training.augmentation.views import inside, warp_points
from improvo.types import Features, Float64

SETTINGS = HomographySettings()
SHAPE = (240, 320)
TRUTH = np.array([[0.9, -0.15, 30.0], [0.1, 1.05, -12.0], [2e-4, -1e-4, 1.0]])


def features_pair(noise: float = 0.0, shuffled: bool = False) -> tuple[Features, Features]:
    """Points of A, and where the homography carries them in B, with descriptors that belong together."""
    rng = np.random.default_rng(0)
    keypoints = rng.uniform([0, 0], [319, 239], (300, 2))
    in_b = warp_points(TRUTH, keypoints)
    keypoints, in_b = keypoints[inside(in_b, 320, 240)], in_b[inside(in_b, 320, 240)]
    descriptors = rng.normal(size=(len(keypoints), 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    moved = in_b + rng.normal(0, 1, in_b.shape) * noise
    scores = np.linspace(1, 0, len(keypoints), dtype=np.float32)
    others = np.roll(descriptors, 50, axis=0) if shuffled else descriptors
    return Features(keypoints.astype(np.float32), descriptors, scores), Features(
        moved.astype(np.float32), others, scores
    )


def measure(a: Features, b: Features) -> dict[str, float | None]:
    return evaluate_pair(a, b, TRUTH, SHAPE, SHAPE, SETTINGS)


def test_perfect_features_have_perfect_measures() -> None:
    measures = measure(*features_pair())
    for name in ("repeatability", "mean_average_precision", "matching_score"):
        assert measures[name] == pytest.approx(1.0, abs=0.02), name
    assert measures["localisation_error"] == pytest.approx(0.0, abs=1e-4)
    assert measures["corner_error"] == pytest.approx(0.0, abs=1e-2)


def test_noise_is_localised_and_moves_the_corners() -> None:
    errors = []
    for noise in (0.0, 0.3, 1.0):
        measures = measure(*features_pair(noise))
        errors.append((measures["localisation_error"], measures["corner_error"]))
    assert errors == sorted(errors)
    assert errors[1][0] == pytest.approx(0.3 * np.sqrt(np.pi / 2), rel=0.1)  # mean of a Rayleigh distribution


def test_shuffled_descriptors_repeat_but_do_not_match() -> None:
    measures = measure(*features_pair(shuffled=True))
    assert measures["repeatability"] == pytest.approx(1.0, abs=0.02)
    for name in ("mean_average_precision", "matching_score"):
        value = measures[name]
        assert value is not None
        assert value < 0.05, name
    assert measures["corner_error"] is not None
    assert measures["corner_error"] > 20


def test_no_keypoints_are_failures() -> None:
    a, b = features_pair()
    measures = measure(a.take(np.zeros(0, np.int64)), b.take(np.zeros(0, np.int64)))
    assert measures["corner_error"] == np.inf
    assert measures["localisation_error"] is None
    assert measures["repeatability"] == measures["matching_score"] == measures["mean_average_precision"] == 0.0


def test_average_precision_of_a_known_ranking() -> None:
    similarity = np.array([[0.9, 0.1], [0.8, 0.2], [0.3, 0.7], [0.1, 0.6]])
    near = np.array([[True, False], [False, True], [False, True], [False, False]])
    # ranked: right, wrong, right, wrong; three points have a partner
    assert matching_precision(similarity, near) == pytest.approx((1.0 + 2 / 3) / 3)


def checkered(seed: int, size: tuple[int, int]) -> np.ndarray:
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (size[0] // 12, size[1] // 12)).astype(np.uint8)
    return cv2.resize(small, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)


def write_hpatches(folder: Path, name: str, homography: Float64, size: tuple[int, int] = SHAPE) -> None:
    scene = folder / name
    scene.mkdir(parents=True)
    image = cv2.cvtColor(checkered(0, size), cv2.COLOR_GRAY2BGR)
    cv2.imwrite(str(scene / "1.ppm"), image)
    cv2.imwrite(str(scene / "2.ppm"), cv2.warpPerspective(image, homography, (size[1], size[0])))
    np.savetxt(scene / "H_1_2", homography)


def test_images_and_homographies_shrink_together(tmp_path: Path) -> None:
    homography = np.array([[1.0, 0.1, 20.0], [-0.05, 0.95, 10.0], [0, 0, 1.0]])
    write_hpatches(tmp_path, "v_board", homography, (480, 640))
    scene = hpatches_scenes(tmp_path)[0]
    assert scene.split == "viewpoint"
    reference, views = open_scene(scene, HomographySettings(longest_side=320))
    assert reference.shape == (240, 320)
    warped = cv2.warpPerspective(reference, views[0].view_from_reference, (320, 240))
    middle = np.s_[60:180, 80:240]
    difference = np.abs(warped[middle].astype(float) - views[0].image[middle]).mean()
    off = np.abs(np.roll(warped, 1, axis=1)[middle].astype(float) - views[0].image[middle]).mean()
    assert difference < 0.4 * off


def test_one_command_on_both_inputs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_hpatches(tmp_path / "patches", "v_board", np.array([[1, 0.02, 5], [-0.02, 1, 3], [0, 0, 1.0]]))
    write_hpatches(tmp_path / "patches", "i_board", np.eye(3))
    words = ["evaluate", "homography", "--frontend", "orb", "--workers", "1"]
    assert main([*words, str(tmp_path / "patches"), "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "viewpoint: 1 pairs" in printed
    rows = json.loads((tmp_path / "out" / "homography.json").read_text())["rows"]
    assert [row["split"] for row in rows] == ["all", "illumination", "viewpoint"]
    assert rows[1]["homography_1px"] == 1.0
    assert rows[1]["repeatability"] == 1.0
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    cv2.imwrite(str(pictures / "a.png"), checkered(1, (240, 320)))
    assert main([*words, "--synthesize", str(pictures), "--views", "3"]) == 0
    first = capsys.readouterr().out
    assert "all: 3 pairs" in first
    assert main([*words, "--synthesize", str(pictures), "--views", "3"]) == 0
    assert capsys.readouterr().out == first


@pytest.mark.parametrize("shape", [(235, 313), (240, 320), (239, 97), (16, 23)])
def test_pictures_of_any_size_are_warped_exactly(shape: tuple[int, int], tmp_path: Path) -> None:
    y, x = np.mgrid[: shape[0], : shape[1]]
    picture = np.rint(60 + x * 130 / shape[1] + y * 60 / shape[0]).astype(np.uint8)  # a plane, whose views are known
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    (scene,) = picture_scenes(tmp_path)
    reference, views = open_scene(scene, HomographySettings(views=4))
    np.testing.assert_array_equal(reference, picture)
    for view in views:
        height, width = view.image.shape
        assert (height, width) == (shape[0] // 8 * 8, shape[1] // 8 * 8)
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
        shown = warp_points(np.linalg.inv(view.view_from_reference), pixels)
        within = inside(shown, shape[1], shape[0])
        assert within.mean() > 0.4
        expected = 60 + shown[..., 0] * 130 / shape[1] + shown[..., 1] * 60 / shape[0]
        assert np.abs(expected - view.image)[within].max() < 1.6


def test_a_picture_of_any_size_is_evaluated_and_a_tiny_one_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), checkered(1, (235, 313)))
    words = ["evaluate", "homography", "--frontend", "orb", "--workers", "1", "--synthesize", str(tmp_path)]
    assert main([*words, "--views", "2"]) == 0
    assert "all: 2 pairs" in capsys.readouterr().out
    cv2.imwrite(str(tmp_path / "b.png"), checkered(1, (15, 40)))
    assert main([*words, "--views", "2"]) == 2
    assert "b.png: is 40x15 pixels; give pictures of 16x16 or more" in capsys.readouterr().err


def test_two_frontends_of_one_label_are_refused_and_what_cannot_run_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), checkered(1, (240, 320)))
    scenes = picture_scenes(tmp_path)
    files = [LoadedFrontend(f"{folder}/weights.safetensors") for folder in "ab"]
    with pytest.raises(ConfigError, match="frontends: `weights` is given twice; name one by LABEL=NAME"):
        run_homography_protocol(scenes, files, SETTINGS)
    words = ["evaluate", "homography", "--synthesize", str(tmp_path), "--views", "2", "--workers", "1"]
    assert main([*words, "--frontend", "orb", "--frontend", "again=orb"]) == 0
    rows = [line.split("|")[1:] for line in capsys.readouterr().out.splitlines() if "orb" in line or "again" in line]
    assert [row[0].strip() for row in rows] == ["orb", "again"]
    assert rows[0][1:] == rows[1][1:]
    found = run_homography_protocol(scenes, [LoadedFrontend("orb")], HomographySettings(views=1))
    text = homography_table({**found, "skipped_frontends": [{"frontend": "surf", "reason": "not installed"}]})
    assert text.endswith("\n\n- frontend surf not run: not installed\n")


def test_bad_folders_are_one_line_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no HPatches scene"):
        hpatches_scenes(tmp_path)
    with pytest.raises(InputError, match="holds no pictures"):
        picture_scenes(tmp_path)
    write_hpatches(tmp_path, "v_board", np.eye(3))
    (tmp_path / "v_board" / "H_1_3").write_text("1 0 0")
    with pytest.raises(InputError, match="no image 3"):
        hpatches_scenes(tmp_path)
    (tmp_path / "v_board" / "H_1_3").unlink()
    (tmp_path / "v_board" / "H_1_2").write_text("1 0 0")
    with pytest.raises(InputError, match="nine numbers"):
        open_scene(hpatches_scenes(tmp_path)[0], SETTINGS)


def test_a_picture_may_have_a_name_that_is_no_text(tmp_path: Path) -> None:
    """Linux takes any bytes."""
    picture = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (64, 80), np.uint8))[1].tobytes()
    with open(os.fsencode(tmp_path) + b"/\xff.png", "wb") as file:
        file.write(picture)
    (scene,) = picture_scenes(tmp_path)
    _, views = open_scene(scene, HomographySettings(views=2))
    assert len(views) == 2
