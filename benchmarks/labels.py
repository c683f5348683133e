"""Which robust solve tells stable tracks from unstable ones best: simulated tracks of known cause under noisy poses.

    python benchmarks/labels.py [--tracks N] [--json FILE]

For each cause and each loss the table gives the share of tracks that the paper's rule then calls stable / unstable.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from improvo.files import write_json
from improvo.geometry import se3
from improvo.stability.rule import STABLE, UNSTABLE, label_stability
from improvo.stability.settings import LabelSettings
from improvo.types import Float64, Tracks

FRAMES = 60
K = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
CAUSES = ("static 0.5 px", "static 0.7 px", "slides", "moving object", "wrong link", "late wrong link", "jitter 2 px")
LOSSES = (("huber", 1000.0), ("huber", 1.0), ("huber", 2.0), ("geman_mcclure", 1.0), ("geman_mcclure", 2.0))
LOSSES += (("geman_mcclure", 4.0),)
POSE_ERROR = 0.3 / 525, 0.0003  # of the final poses: radians (a third of a pixel) and map units


def main() -> None:
    """Simulate, label with each loss, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tracks", type=int, default=1500, help="per cause")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    truth = camera_motion()
    parts = [simulated_track(truth, cause, rng) for cause in CAUSES for _ in range(arguments.tracks)]
    tracks = Tracks(
        frame=np.concatenate([frames for frames, _ in parts]),
        track=np.repeat(np.arange(len(parts)), [len(frames) for frames, _ in parts]),
        keypoints=np.concatenate([keypoints for _, keypoints in parts]).astype(np.float32),
        weight=np.ones(sum(len(frames) for frames, _ in parts), np.float32),
    )
    turn, shift = POSE_ERROR
    jitter = se3.rigid(se3.so3_exp(rng.normal(0, turn, (FRAMES, 3))), rng.normal(0, shift, (FRAMES, 3)))
    print(f"{'stable / unstable, %':22s}" + "".join(f"{cause:>18s}" for cause in CAUSES))
    rows = []
    for loss, width in LOSSES:
        settings = LabelSettings(loss=loss, loss_width=width)
        labels = label_stability(tracks, jitter @ truth, np.zeros(FRAMES, np.int64), K, settings)
        codes = labels.stability.reshape(len(CAUSES), -1)
        shares = {
            c: (float((r == STABLE).mean()), float((r == UNSTABLE).mean())) for c, r in zip(CAUSES, codes, strict=True)
        }
        rows.append({"loss": loss, "width": width, "shares": shares})
        cells = "".join(f"{100 * stable:9.1f} /{100 * unstable:6.1f} " for stable, unstable in shares.values())
        print(f"{loss + f' {width:g}':22s}" + cells)
    if arguments.json:
        write_json(arguments.json, {"tracks_per_cause": arguments.tracks, "rows": rows})


def camera_motion() -> Float64:
    """(FRAMES, 4, 4) two seconds by hand: half a unit per second sideways, some turning."""
    time = np.arange(FRAMES) / 30
    centres = np.stack([0.5 * time, 0.05 * np.sin(4 * time), 0.1 * time], axis=1)
    turns = np.stack([0.05 * np.sin(3 * time), 0.15 * np.sin(2 * time), 0.02 * time], axis=1)
    return se3.inverse(se3.rigid(se3.so3_exp(turns), centres))


def simulated_track(cam_from_world: Float64, cause: str, rng: np.random.Generator) -> tuple[np.ndarray, Float64]:
    """Frames (T,) and keypoints (T, 2) of a track of 10 to 39 frames."""
    length = int(rng.integers(10, 40))
    frames = np.arange(length) + rng.integers(0, FRAMES - length + 1)
    points = np.array([rng.uniform(-0.8, 0.8), rng.uniform(-0.6, 0.6), 1.0]) * rng.uniform(0.6, 3.0)
    points = np.tile(points + se3.inverse(cam_from_world)[frames[0], :3, 3], (length, 1))
    direction = rng.normal(size=3)
    if cause == "moving object":
        speed = rng.uniform(0.2, 1.0) / 30  # map units a frame
        points += speed * direction / np.linalg.norm(direction) * np.arange(length)[:, None]
    poses = cam_from_world[frames]
    in_camera = np.einsum("fij,fj->fi", poses[:, :3, :3], points) + poses[:, :3, 3]
    keypoints = in_camera[:, :2] / in_camera[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    along = direction[:2] / np.linalg.norm(direction[:2])
    if cause == "slides":
        keypoints += rng.uniform(0.2, 1.0) * along * np.arange(length)[:, None]
    if cause in ("wrong link", "late wrong link"):
        jump = length - rng.integers(1, 3) if cause.startswith("late") else rng.integers(3, length - 2)
        keypoints[jump:] += rng.uniform(6, 15) * along
    noise = {"static 0.7 px": 0.7, "jitter 2 px": 2.0}.get(cause, 0.5)
    return frames, keypoints + rng.normal(0, noise, keypoints.shape)


if __name__ == "__main__":
    main()
