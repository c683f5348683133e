"""How exactly frontends place their keypoints: python benchmarks/keypoint_accuracy.py [SEQUENCE ...]

Mutual nearest neighbours of two frames against where depth and true poses put them. Sequences need both; the bundled
simulated room by default. A network's row is repeated for several radii of its move to the image's corners.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from improvo.frontend import Frontend
from improvo.frontend.network import load_network_frontend
from improvo.frontend.registry import load_frontend
from improvo.geometry.se3 import inverse, transform
from improvo.sequences import Sequence, open_sequence
from improvo.simulation import bundled_sequence
from improvo.tracking.matching import mutual_nearest_neighbours
from improvo.types import Float64

KEYPOINTS = 500
RADII = (0, 3, 4, 5, 6)


def match_errors(sequence: Sequence, frontend: Frontend, a: int, b: int) -> Float64:
    """Pixels (N,) between matched keypoints of frame b and the true places of those of frame a that it shows."""
    depth, truth = sequence.depth(a), sequence.ground_truth
    assert depth is not None
    assert truth is not None
    first, second = frontend(sequence[a].image), frontend(sequence[b].image)
    matches = mutual_nearest_neighbours(first, second, None)
    places, found = first.keypoints[matches[:, 0]].astype(np.float64), second.keypoints[matches[:, 1]]
    columns, rows = np.clip(np.round(places), 0, (depth.shape[1] - 1, depth.shape[0] - 1)).astype(np.int64).T
    points = sequence.camera.unproject(places) * depth[rows, columns][:, None]
    b_from_a = inverse(truth.world_from_cam[b]) @ truth.world_from_cam[a]
    expected = sequence.camera.project(transform(b_from_a, points))
    with np.errstate(invalid="ignore"):
        shown = ((expected >= 0) & (expected < [sequence.camera.width, sequence.camera.height])).all(axis=1)
    return np.asarray(np.linalg.norm(expected - found, axis=1)[shown])


def spread_rows(sequence: Sequence, gap: int, pairs: int) -> list[int]:
    """About so many frames with depth, spread evenly, that have another one `gap` frames later."""
    usable = [row for row in range(len(sequence) - gap) if sequence.depth(row) is not None]
    return usable[:: max(1, len(usable) // pairs)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*", type=Path, default=[bundled_sequence()])
    parser.add_argument("--frontend", nargs="+", default=["superpoint-small", "superpoint-vo"], help="networks")
    parser.add_argument("--gap", type=int, default=5, help="frames between the two")
    parser.add_argument("--pairs", type=int, default=12, help="of each sequence")
    arguments = parser.parse_args()
    frontends: dict[str, Frontend] = {
        name: load_frontend(name, KEYPOINTS, opencv_defaults=True) for name in ("sift", "orb", "akaze")
    }
    for name in arguments.frontend:
        for radius in RADII:
            frontends[f"{name}, corner radius {radius}"] = load_network_frontend(
                name, max_keypoints=KEYPOINTS, corner_radius=radius
            )
    sequences = [open_sequence(path) for path in arguments.sequences]
    print("a pair: matches shown by both; within 3, 1, 0.5 px; median error of those within 3 px")
    for label, frontend in frontends.items():
        errors = [
            match_errors(sequence, frontend, row, row + arguments.gap)
            for sequence in sequences
            for row in spread_rows(sequence, arguments.gap, arguments.pairs)
        ]
        count, together = len(errors), np.concatenate(errors)
        within = [f"{(together < limit).sum() / count:6.0f}" for limit in (3, 1, 0.5)]
        median = np.median(together[together < 3])
        print(f"{label:36s} {len(together) / count:6.0f} {' '.join(within)} {median:6.2f}")


if __name__ == "__main__":
    main()
