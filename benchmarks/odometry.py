"""Odometry on the real sequences beside the project: accuracy, segments and speed, for frontends, modes and seeds.

    python benchmarks/odometry.py                      # the whole table, about an hour on one core
    python benchmarks/odometry.py --sequence kitti00 --frontend orb --mode robust --seeds 1

Each row: frames with a pose, segments, ATE after Sim3 per segment as % of the true path, relative errors over 2 s,
milliseconds per frame of the frontend and of everything else but reading pictures (one thread each; `improvo run`
overlaps them), and whether the run is silently wrong: a segment with over 5 % of ATE that the run itself neither
contradicts nor doubts. Where a folder has `truth-sfm.txt`, that is the truth (--own-truth: not); the odometry keeps the
recording's own camera. `--solver opencv` is what runs where PoseLib is not installed.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from improvo.backend.compile import compile_kernels
from improvo.evaluation.settings import TrajectorySettings
from improvo.evaluation.trajectory.protocol import evaluate_trajectory
from improvo.evaluation.truth.referenced import open_with_truth
from improvo.frontend.registry import load_frontend
from improvo.geometry.ransac import robust_solver
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.sequences import Sequence, SequenceSettings, open_sequence
from improvo.types import Features, Trajectory
from robustness_measures import doubt

DATA = Path(__file__).parents[2] / "shared" / "data"
SEQUENCES = ("redkitchen", "hololens-office", "checkerboard-desk", "kitti00", "fr3-notexture")
FRONTENDS = ("sift", "akaze", "orb")
BETTER_TRUTH = "truth-sfm.txt"  # poses by structure from motion, beside a recording whose own are worse
SILENTLY_WRONG = 5.0  # % of the path


@dataclass(frozen=True)
class Row:
    """One run."""

    sequence: str
    frontend: str
    mode: str
    solver: str
    seed: int
    frames: int
    poses: int
    segments: int
    ate_percent: float | None  # of all aligned segments together
    worst_segment_percent: float | None
    ate_percent_without_first_15: float | None  # kitti00's truth is an artefact there
    rotation_2s_deg: float | None
    translation_2s_percent: float | None
    frontend_ms: float
    odometry_ms: float
    contradictions: int  # alarms of the two-view check
    silent_segments: int  # over SILENTLY_WRONG, and nothing is said against them


def main() -> None:
    """Run and print the table."""
    arguments = parse()
    cv2.setNumThreads(1)
    if arguments.solver == "opencv":
        sys.modules["poselib"] = None  # type: ignore[assignment]
    assert robust_solver().name == arguments.solver
    compile_kernels(print)
    rows: list[Row] = []
    print(HEADER)
    for name in arguments.sequence:
        for frontend in arguments.frontend:
            for row in runs(
                arguments.data / name,
                frontend,
                arguments.mode,
                arguments.seeds,
                arguments.max_keypoints,
                arguments.own_truth,
            ):
                rows.append(row)
                print(formatted(row), flush=True)
                if arguments.json:
                    arguments.json.write_text(json.dumps([asdict(each) for each in rows], indent=1))


def runs(
    folder: Path, frontend_name: str, modes: list[str], seeds: int, max_keypoints: int, own_truth: bool
) -> Iterator[Row]:
    """All modes and seeds of one sequence and frontend; the features are computed once."""
    sequence = open_sequence(folder)
    frontend = load_frontend(frontend_name, max_keypoints)
    detected, spent = [], 0.0
    for frame in sequence:  # reading it is part of neither time
        start = time.perf_counter()
        detected.append((frame.time, frontend(frame.image)))
        spent += time.perf_counter() - start
    frontend_ms = 1e3 * spent / len(detected)
    better = folder / BETTER_TRUTH
    judged = open_with_truth(folder, SequenceSettings(), better) if better.is_file() and not own_truth else sequence
    truth = judged.ground_truth
    assert truth is not None
    for mode in modes:
        for seed in range(seeds if mode == "robust" else 1):  # the mode `paper` draws no random numbers
            settings = OdometrySettings(mode=mode, seed=seed)
            odometry = VisualOdometry(frontend, sequence.camera, settings)
            odometry_ms = 1e3 * track(odometry, detected, sequence) / len(detected)
            yield measured(folder.name, frontend_name, mode, seed, odometry, truth, frontend_ms, odometry_ms)


def track(odometry: VisualOdometry, detected: list[tuple[float, Features]], sequence: Sequence) -> float:
    """The whole sequence; seconds without those that its pictures took to be read."""
    spent = 0.0
    for (when, features), frame in zip(detected, sequence, strict=True):
        start = time.perf_counter()
        odometry.track_features(features, when, frame.image)
        spent += time.perf_counter() - start
    start = time.perf_counter()
    odometry.finish()
    return spent + time.perf_counter() - start


def measured(
    sequence: str,
    frontend: str,
    mode: str,
    seed: int,
    odometry: VisualOdometry,
    truth: Trajectory,
    frontend_ms: float,
    odometry_ms: float,
) -> Row:
    """The row of a finished run."""
    estimate = odometry.trajectory
    settings = TrajectorySettings(alignment="sim3")
    errors = evaluate_trajectory(estimate, truth, settings) if estimate.valid.any() else None
    two_seconds = (
        next((each for each in errors.relative if each.unit == "s" and each.length == 2.0), None) if errors else None
    )
    later = None
    if sequence == "kitti00" and estimate.valid[15:].any():
        rest = Trajectory(estimate.times[15:], estimate.world_from_cam[15:], estimate.segment[15:])
        later = evaluate_trajectory(rest, truth, settings).ate_percent
    by_segment = {each.segment: each.ate_percent for each in errors.segments} if errors else {}
    worst = [percent for percent in by_segment.values() if percent is not None]
    wrong = {number for number, percent in by_segment.items() if percent is not None and percent > SILENTLY_WRONG}
    return Row(
        sequence=sequence,
        frontend=frontend,
        mode=mode,
        solver=robust_solver().name,
        seed=seed,
        frames=len(estimate),
        poses=int(estimate.valid.sum()),
        segments=len(odometry.segments),
        ate_percent=errors.ate_percent if errors else None,
        worst_segment_percent=max(worst, default=None),
        ate_percent_without_first_15=later,
        rotation_2s_deg=two_seconds.rotation_deg.mean if two_seconds and two_seconds.rotation_deg else None,
        translation_2s_percent=two_seconds.translation_percent if two_seconds else None,
        frontend_ms=frontend_ms,
        odometry_ms=odometry_ms,
        contradictions=sum(event.kind == "contradiction" for event in odometry.events),
        silent_segments=sum(not doubt(each, odometry.events) for each in odometry.segments if each.number in wrong),
    )


HEADER = (
    "| sequence | frontend | mode | solver | seed | poses | segments | ATE % | worst segment % | rot 2 s ° "
    "| trans 2 s % | frontend ms | odometry ms | alarms |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)


def formatted(row: Row) -> str:
    """A row of the Markdown table."""
    ate = number(row.ate_percent, 3)
    if row.ate_percent_without_first_15 is not None:
        ate += f" ({row.ate_percent_without_first_15:.3f} without the first 15)"
    wrong = row.worst_segment_percent is not None and row.worst_segment_percent > SILENTLY_WRONG
    verdict = " SILENTLY WRONG" if row.silent_segments else " (alarm)" if wrong else ""
    cells = (
        row.sequence,
        row.frontend,
        row.mode,
        row.solver,
        str(row.seed),
        f"{row.poses}/{row.frames}",
        str(row.segments),
        ate,
        number(row.worst_segment_percent, 2) + verdict,
        number(row.rotation_2s_deg, 2),
        number(row.translation_2s_percent, 2),
        f"{row.frontend_ms:.0f}",
        f"{row.odometry_ms:.0f}",
        str(row.contradictions),
    )
    return "| " + " | ".join(cells) + " |"


def number(value: float | None, digits: int) -> str:
    """A figure, or a dash where there is none."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def parse() -> argparse.Namespace:
    """The command line; lists default to everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--sequence", nargs="+", default=list(SEQUENCES))
    parser.add_argument("--frontend", nargs="+", default=list(FRONTENDS))
    parser.add_argument("--mode", nargs="+", default=["robust", "paper"], choices=("robust", "paper"))
    parser.add_argument("--solver", default="poselib", choices=("poselib", "opencv"), help="of poses from matches")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--max-keypoints", type=int, default=1000)
    parser.add_argument("--own-truth", action="store_true", help=f"also where there is a {BETTER_TRUTH}")
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    main()
