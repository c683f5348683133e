"""Camera and mask beside a recording count by what is in them, and are found from any working folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from improvo.labeling.label_sequences import fingerprint
from improvo.odometry.run_settings import LabelRunSettings
from improvo.sequences import SequenceSettings
from improvo.sequences.given_files import contents_of_given, with_absolute_files

CAMERA = "fx: {}\nfy: 500\ncx: 320\ncy: 240\nwidth: 640\nheight: 480\n"


def of(camera: Path | str | None = None, mask: Path | None = None) -> dict[str, str]:
    given = (None if value is None else str(value) for value in (camera, mask))
    return contents_of_given(SequenceSettings(camera=next(given), mask=next(given)))


def test_a_camera_counts_by_its_content_and_numbers_by_themselves(tmp_path: Path) -> None:
    first, copied, changed = (tmp_path / name for name in ("a.yaml", "b.yaml", "c.yaml"))
    first.write_text(CAMERA.format(500))
    copied.write_text(CAMERA.format(500))
    changed.write_text(CAMERA.format(501))
    assert of(first) == of(copied) != of(changed)
    assert of("500,500,320,240") == {"camera_content": "500,500,320,240", "mask_content": ""}
    assert of() == {"camera_content": "", "mask_content": ""}


def test_a_folder_of_cameras_may_grow_and_one_of_masks_may_not(tmp_path: Path) -> None:
    (tmp_path / "0.png").write_bytes(b"white")
    before = of(tmp_path, tmp_path)
    (tmp_path / "1.png").write_bytes(b"black")
    after = of(tmp_path, tmp_path)
    assert before["camera_content"] == after["camera_content"]
    assert before["mask_content"] != after["mask_content"]
    (tmp_path / "1.png").rename(tmp_path / "2.png")
    assert of(mask=tmp_path) != after


def test_files_are_found_from_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA.format(500))
    monkeypatch.chdir(tmp_path)
    settings = with_absolute_files(SequenceSettings(camera="camera.yaml", mask="missing.png"))
    assert settings.camera == str(tmp_path / "camera.yaml")
    assert settings.mask == "missing.png"
    assert with_absolute_files(SequenceSettings(camera="auto")).camera == "auto"
    assert with_absolute_files(SequenceSettings(camera="500,500,320,240")).camera == "500,500,320,240"


def test_labels_depend_on_the_camera_s_content(tmp_path: Path) -> None:
    camera = tmp_path / "camera.yaml"
    camera.write_text(CAMERA.format(500))
    settings = LabelRunSettings(sequence=SequenceSettings(camera=str(camera)))
    before = fingerprint(settings, pack=False)
    assert fingerprint(settings, pack=False) == before
    camera.write_text(CAMERA.format(400))
    assert fingerprint(settings, pack=False) != before
