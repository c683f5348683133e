"""The public API: names that resolve, with real types, from a module that costs nothing to import."""

from __future__ import annotations

import importlib.util
import pkgutil
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import improvo
from improvo.simulation import bundled_sequence

ROOT = Path(__file__).parents[1]
PROGRAM = """
import numpy as np

import improvo

sequence = improvo.open_sequence("video.mp4", camera="camera.yaml")
frontend = improvo.load_frontend("superpoint-vo", max_keypoints=500)
with improvo.VisualOdometry(frontend, sequence.camera, improvo.OdometrySettings(seed=1)) as odometry:
    for frame in sequence:
        features = frontend(frame.image)
        tracked = odometry.track(frame)
        reveal_type(frame)
        reveal_type(features)
        reveal_type(tracked)
        reveal_type(odometry.pose)
reveal_type(sequence)
reveal_type(sequence.camera)
reveal_type(frontend)
reveal_type(odometry)
reveal_type(odometry.trajectory)
reveal_type(odometry.trajectory.camera_centers)
reveal_type(odometry.map.xyz)
reveal_type(odometry.segments)
reveal_type(odometry.events)
reveal_type(improvo.match(features, features))
reveal_type(improvo.preset(improvo.RunSettings, "paper"))
reveal_type(improvo.run("video.mp4", "out"))
reveal_type(improvo.run(sequence, "out", improvo.RunSettings()).trajectory)
reveal_type(improvo.label(["a.mp4", "b.mp4"], "labels"))
reveal_type(improvo.label_stability)
reveal_type(improvo.train_odometry(["labels"], "out", start="superpoint").weights)
reveal_type(improvo.improve(["a.mp4"], "out", rounds=2))
reveal_type(improvo.evaluate_pose(["room"], ["sift"], improvo.PoseSettings(pairs=10))[0].rotation_success)
reveal_type(improvo.evaluate_trajectory("out", "room").ate_m)
reveal_type(improvo.RunFolder)
try:
    improvo.open_sequence("nowhere")
except improvo.InputError as error:
    reveal_type(error)
"""


def test_every_public_name_resolves_and_is_listed() -> None:
    for name in improvo.__all__:
        assert getattr(improvo, name) is not None, name
        assert name in dir(improvo)
    assert set(improvo._PUBLIC) == set(improvo.__all__) - {"__version__"}
    with pytest.raises(AttributeError, match="no attribute 'runn'"):
        improvo.runn  # type: ignore[attr-defined]  # noqa: B018


def test_the_reference_has_every_public_name() -> None:
    text = (ROOT / "docs" / "reference.md").read_text()
    whole = set(re.findall(r"^::: (improvo[\w.]+)$", text, flags=re.MULTILINE))
    listed = {
        f"{module}.{member}"
        for module, members in re.findall(
            r"^::: (improvo[\w.]+)\n    options:\n      members: \[([^\]]+)\]", text, re.M
        )
        for member in members.split(", ")
    }
    whole -= {name.rpartition(".")[0] for name in listed}
    for name in whole | listed:
        pkgutil.resolve_name(name)  # it is there
    for name, place in improvo._PUBLIC.items():
        found: Any = getattr(improvo, name)
        module, own = found.__module__, found.__name__
        assert {module, f"{module}.{own}"} & (whole | listed), f"{name} ({place}): is not in docs/reference.md"
    verbs = [getattr(improvo, name) for name, place in improvo._PUBLIC.items() if place == "improvo.verbs"]
    for returned in {name for verb in verbs for name in re.findall(r"[A-Z]\w+", verb.__annotations__["return"])}:
        assert re.search(rf"\b{returned}\b", text), f"{returned}: is not in docs/reference.md"


def test_import_is_light() -> None:
    heavy = ["numpy", "cv2", "numba", "torch", "scipy", "pyarrow", "openvino", "yaml", "matplotlib"]
    code = f"import improvo, sys; print([name for name in {heavy} if name in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.skipif(importlib.util.find_spec("mypy") is None, reason="needs mypy: pip install 'improvo[dev]'")
def test_a_users_program_has_types_and_no_any(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file=", "--follow-imports=silent", str(program)]
    checked = subprocess.run(
        [*command, "--cache-dir", str(tmp_path)],
        env={"MYPYPATH": str(ROOT / "src"), "PATH": "/usr/bin:/bin"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    revealed = re.findall(r'Revealed type is "(.*)"', checked.stdout)
    assert ": error:" not in checked.stdout, checked.stdout
    assert len(revealed) == PROGRAM.count("reveal_type"), checked.stdout
    for text in revealed:
        of_shape = re.sub(r"tuple\[Any, \.\.\.\]", "", text)  # NumPy's own type for any shape
        assert "Any" not in re.sub(r"dtype\[Any\]", "", of_shape), text


def test_the_verbs_do_what_the_commands_do(tmp_path: Path) -> None:
    few = improvo.SequenceSettings(max_frames=40)
    settings = improvo.RunSettings(sequence=few, frontend=improvo.FrontendSettings("orb", max_keypoints=300))
    summary = improvo.run(bundled_sequence(), tmp_path / "run", settings)
    assert summary.tracked == 40
    errors = improvo.evaluate_trajectory(tmp_path / "run", bundled_sequence())
    assert errors.ate_percent is not None
    assert errors.ate_percent < 5
    [record] = improvo.label([bundled_sequence()], tmp_path / "labels", settings)
    assert record.state == "done"
    pose = improvo.PoseSettings(gaps=(5,), pairs=4, estimators=("poselib",))
    [cell] = improvo.evaluate_pose([bundled_sequence()], ["orb"], pose)
    assert (cell.frontend, cell.estimator, cell.gap, cell.pairs) == ("orb", "poselib", 5, 4)
    in_seconds = improvo.PoseSettings(gap_seconds=(0.2,), pairs=4, estimators=("poselib",))
    [cell] = improvo.evaluate_pose([bundled_sequence()], ["orb"], in_seconds)
    assert cell.gap == 6
    assert 0 <= cell.rotation_interval[0] <= cell.rotation_success <= cell.rotation_interval[1] <= 1


def test_match_and_a_frontend_by_name() -> None:
    image = improvo.open_sequence(bundled_sequence())[0].image
    features = improvo.load_frontend("orb", 100)(image)
    matches = improvo.match(features, features)
    np.testing.assert_array_equal(matches[:, 0], matches[:, 1])


def test_presets_are_typed_settings_and_unknown_ones_are_refused() -> None:
    paper = improvo.preset(improvo.RunSettings, "paper")
    assert paper.labels.quality.enabled is False
    assert improvo.preset(improvo.OdometryTrainingSettings, "paper").pairs.wide_baselines == 0
    assert improvo.preset(improvo.ImproveSettings, "paper").training.optimiser.steps == 1000
    with pytest.raises(improvo.ConfigError, match="choose paper"):
        improvo.preset(improvo.RunSettings, "papyrus")
    with pytest.raises(improvo.ConfigError, match="none for these"):
        improvo.preset(improvo.SequenceSettings, "paper")
