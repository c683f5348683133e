"""Mean average precision of detectors on drawn shapes with noise.

PYTHONPATH=tests python benchmarks/detector.py [WEIGHTS ...]
"""

from __future__ import annotations

import argparse

import numpy as np

from improvo.frontend.network import load_network_frontend
from improvo.training.settings import PhotometricSettings
from improvo.types import Float32, UInt8
from shape_detection import ScoredDetector, classical_detectors, mean_average_precision, shape_tests


def network(name: str, keypoints: int = 100) -> ScoredDetector:
    """A network as a detector; every local maximum counts, as with the classical ones."""
    frontend = load_network_frontend(name, max_keypoints=keypoints, threshold=0.0, border=0)

    def detect(image: UInt8) -> tuple[Float32, Float32]:
        features = frontend(image)
        return features.keypoints, features.scores

    return detect


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weights", nargs="*", default=["superpoint", "superpoint-small"])
    parser.add_argument("--pictures", type=int, default=60, help="of each of the nine families")
    parser.add_argument("--seed", type=int, default=1000, help="not one that anything was trained with")
    arguments = parser.parse_args()
    detectors = {**classical_detectors(), **{name: network(name) for name in arguments.weights}}
    sets = {
        "without noise": shape_tests(arguments.pictures, arguments.seed),
        "with noise": shape_tests(arguments.pictures, arguments.seed, PhotometricSettings()),
    }
    for title, tests in sets.items():
        print(f"\n{title}, {len(tests)} pictures of 160x120, correct within 3 pixels")
        for name, detect in detectors.items():
            mean, families = mean_average_precision(detect, tests)
            parts = "  ".join(f"{family} {value:.2f}" for family, value in families.items())
            print(f"{name:>20}  mAP {mean:.3f}   {parts}")
            assert np.isfinite(mean)


if __name__ == "__main__":
    main()
