"""--camera and --fov win over a calibration in the recording that cannot be used; without them it is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sequence_encoders as encoders
from improvo.errors import InputError
from improvo.sequences import open_sequence
from sequence_builders import CAMERA, write_video
from sequence_encoders import Scene
from test_sequences_encoded import scene

BROKEN = "camera_model: magic\nintrinsics: [1, 2]\nfx: [\n"


def broken(path: Path, text: str = BROKEN) -> None:
    path.write_text(text)


def tum(folder: Path, scene: Scene) -> Path:
    encoders.write_tum(folder, scene)
    broken(folder / "camera.yaml")
    return folder


def images(folder: Path, scene: Scene) -> Path:
    encoders.write_image_folder(folder, scene)
    broken(folder / "camera.yaml")
    return folder


def seven_scenes(folder: Path, scene: Scene) -> Path:
    encoders.write_seven_scenes(folder, scene, 30.0)
    broken(folder / "camera.yaml", "distortion: [1, 2, 3]\nfx: 1\nfy: 1\ncx: 1\ncy: 1\n")
    return folder


def kitti(folder: Path, scene: Scene) -> Path:
    encoders.write_kitti(folder, scene)
    broken(folder / "calib.txt", "P0: 1 2 3\n")
    return folder


def euroc(folder: Path, scene: Scene) -> Path:
    encoders.write_euroc(folder, scene, np.eye(4))
    broken(folder / "mav0" / "cam0" / "sensor.yaml")
    return folder


def transforms(folder: Path, scene: Scene) -> Path:
    encoders.write_transforms(folder, scene)
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps({**content, "camera_model": "EQUIRECTANGULAR"}))
    return folder


def polycam(folder: Path, scene: Scene) -> Path:
    encoders.write_polycam(folder, scene)
    for file in folder.rglob("cameras/*.json"):
        file.write_text(json.dumps({**json.loads(file.read_text()), "fx": None}))
    return folder


def scannet(folder: Path, scene: Scene) -> Path:
    encoders.write_scannet_folder(folder, scene)
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", -np.eye(4))
    return folder


def icl(folder: Path, scene: Scene) -> Path:
    encoders.write_icl(folder, scene)
    broken(folder / "camera.yaml")
    return folder


def video(folder: Path, scene: Scene) -> Path:
    folder.mkdir()
    write_video(folder / "walk.avi", scene.images)
    broken(folder / "walk.yaml")
    return folder / "walk.avi"


WRITERS: list[Callable[[Path, Scene], Path]] = [
    *(tum, images, seven_scenes, kitti, euroc, transforms, polycam, scannet, icl, video)
]


@pytest.mark.parametrize("write", WRITERS, ids=[write.__name__ for write in WRITERS])
def test_a_broken_calibration_stops_nobody_who_gives_his_own(
    tmp_path: Path, write: Callable[[Path, Scene], Path]
) -> None:
    path = write(tmp_path / "recording", scene())
    with pytest.raises(InputError, match=r"[^\n]*(camera|calib|sensor|transforms|walk|intrinsic)[^\n]*") as error:
        open_sequence(path)
    assert "\n" not in str(error.value)
    own = open_sequence(path, camera="90,91,47,36.5")
    assert own.camera == CAMERA
    assert own[0].image.shape == (CAMERA.height, CAMERA.width)
    own.depth(0)
    assert any("its own calibration is left out for --camera" in note for note in own.notes)
    assert open_sequence(path, fov=60.0).camera.fx == pytest.approx(0.5 * CAMERA.width / np.tan(np.pi / 6))


def test_depth_scale_of_the_given_camera_counts(tmp_path: Path) -> None:
    path = tum(tmp_path / "recording", scene())
    text = "width: 96\nheight: 72\nfx: 90\nfy: 91\ncx: 47\ncy: 36.5\ndepth_scale: 500\n"
    (tmp_path / "own.yaml").write_text(text)
    depth = open_sequence(path, camera=str(tmp_path / "own.yaml")).depth(0)
    assert depth is not None
    np.testing.assert_allclose(depth, 2 * scene().depths[0], rtol=1e-6)
