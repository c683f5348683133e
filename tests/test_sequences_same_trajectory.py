"""One simulated recording, written in every lossless format, gives the same `trajectory.txt`, byte for byte."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ros_encoders
import sequence_encoders as encoders
from improvo.cli.main import main
from improvo.geometry.camera_files import calibration_yaml
from improvo.sequences import open_sequence, read_trajectory
from sequence_builders import write_video
from sequence_encoders import Scene

FRAMES = 24
FPS = 8.0  # a binary fraction: every format holds the times exactly


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    from improvo.simulation.generate import simulate
    from improvo.simulation.settings import SimulationSettings

    folder = tmp_path_factory.mktemp("simulated") / "s"
    settings = SimulationSettings(
        frames=FRAMES, fps=FPS, width=192, height=144, walkers=0, swinging_lamp=False, drawer=False,
        blur_samples=1, colour=False, speed=0.5, turn=10.0,
    )  # fmt: skip
    simulate(settings, folder)
    sequence = open_sequence(folder)
    frames = list(sequence)
    depths = [sequence.depth(i) for i in range(FRAMES)]
    whole = [(np.rint(depth * 1000) / 1000).astype(np.float32) for depth in depths if depth is not None]
    assert len(whole) == len(frames) == FRAMES
    assert sequence.ground_truth is not None
    camera = sequence.camera
    camera = replace(camera, **{n: float(np.float32(getattr(camera, n))) for n in ("fx", "fy", "cx", "cy")})
    images = [frame.image for frame in frames]
    return Scene(camera, np.arange(FRAMES) / FPS, images, whole, sequence.ground_truth.world_from_cam)


def test_every_lossless_format_gives_the_same_trajectory(tmp_path: Path, simulated: Scene) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    write_video(folder / "v.mp4", simulated.images, fps=FPS, codec="FFV1")
    (folder / "v.yaml").write_text(calibration_yaml(simulated.camera))
    recordings = {
        "tum": encoders.write_tum(folder / "tum", simulated),
        "images": encoders.write_image_folder(folder / "images-only", simulated),
        "7scenes": encoders.write_seven_scenes(folder / "7scenes", simulated, FPS),
        "kitti": encoders.write_kitti(folder / "kitti", simulated),
        "euroc": encoders.write_euroc(folder / "euroc", simulated, np.eye(4)),
        "sens": encoders.write_sens(folder / "s.sens", simulated),
        "rosbag": ros_encoders.write_bag(folder / "s.bag", simulated, 1),
        "rosbag 2": ros_encoders.write_bag(folder / "ros2", simulated, 2),
        "video": folder / "v.mp4",
    }
    trajectories = {}
    for name, path in recordings.items():
        sequence = open_sequence(path)
        assert sequence.format == name.split()[0]
        assert sequence.camera == simulated.camera
        assert sequence.times.tolist() == simulated.times.tolist()
        assert sequence.present.tolist() == list(range(FRAMES))
        assert all((frame.image == image).all() for frame, image in zip(sequence, simulated.images, strict=True))
        if name in ("tum", "video"):
            # equal inputs give equal outputs, so two runs are enough
            out = tmp_path / f"run-{name}"
            assert main(["run", str(path), "-o", str(out), "--frontend", "orb", "--max-keypoints", "400"]) == 0
            trajectories[name] = (out / "trajectory.txt").read_bytes()
    assert len(set(trajectories.values())) == 1
    assert len(read_trajectory(tmp_path / "run-tum" / "trajectory.txt")) > FRAMES // 2
