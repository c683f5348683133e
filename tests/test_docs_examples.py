"""Every Python example of README and docs runs as it stands, in a folder that holds what it reads."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import improvo
from improvo.simulation import bundled_sequence

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FRAMES = 24


def examples() -> list[Any]:
    """One parameter for each fenced block of Python."""
    found = []
    for page in PAGES:
        blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        found += [pytest.param(page.stem, block, id=f"{page.stem}-{i}") for i, block in enumerate(blocks)]
    return found


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short video, its camera, and a picture."""
    folder = tmp_path_factory.mktemp("examples")
    frames = sorted((bundled_sequence() / "rgb").iterdir())[:FRAMES]
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in frames]
    size = images[0].shape[1], images[0].shape[0]
    writer = cv2.VideoWriter(str(folder / "video.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, size, False)
    for image in images:
        writer.write(image)
    writer.release()
    shutil.copy(bundled_sequence() / "camera.yaml", folder)
    cv2.imwrite(str(folder / "picture.jpg"), images[0])
    return folder


def backend_names(place: Path) -> dict[str, Any]:
    from improvo.backend.simulated import simulated_window

    problem = simulated_window().problem
    return {name: getattr(problem, name) for name in problem.__dataclass_fields__}


def label_store(place: Path) -> dict[str, Any]:
    settings = improvo.LabelRunSettings(improvo.SequenceSettings(max_frames=40))
    improvo.label([bundled_sequence()], place / "LABELS", settings)
    return {}


def exported_model(place: Path) -> dict[str, Any]:
    if (place / "run").exists():
        return {}
    pytest.importorskip("onnx", reason="needs onnx: pip install 'improvo[dev]'")
    pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'improvo[dev]'")
    from improvo.cli.main import main

    assert main(["run", str(bundled_sequence()), "-o", str(place / "run"), "--frontend", "orb"]) == 0
    assert main(["export", "colmap", str(place / "run"), "-o", str(place / "scene"), "--no-images"]) == 0
    target = ["--max-keypoints", "500", "-o", str(place / "opencv.onnx")]
    assert main(["export", "onnx", "superpoint-small", "--layout", "opencv", *target]) == 0
    return {}


def pictures(place: Path) -> dict[str, Any]:
    image = cv2.imread(str(place / "picture.jpg"))
    return {"image": image, "first": image, "second": image}


def frames_and_features(place: Path) -> dict[str, Any]:
    (place / "frames").mkdir()
    shutil.copy(place / "picture.jpg", place / "frames" / "0.jpg")
    cv2.imwrite(str(place / "frames" / "0.png"), np.zeros((80, 80), np.uint8))
    sys.argv = ["program.py", "frames", "features"]
    return {}


# page -> makes what its examples read beside video.mp4, camera.yaml and picture.jpg, and gives the names they use
NEEDS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "backend": backend_names,
    "export": exported_model,
    "features-from-elsewhere": frames_and_features,
    "frontend": pictures,
    "labels": label_store,
}


@pytest.mark.parametrize(("page", "code"), examples())
def test_example_runs(page: str, code: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    monkeypatch.setattr(sys, "argv", ["program.py"])
    names = NEEDS[page](place) if page in NEEDS else {}
    exec(compile(code, f"example of {page}", "exec"), {"__name__": "__main__", **names})
