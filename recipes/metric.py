"""Map the descriptors of weights by what a pack's posed frames say: python recipes/metric.py pack.zip WEIGHTS -o OUT

The pack is that of recipes/gpu_pack.py. OUT gets `weights.safetensors`, which recipes/bundle.py puts into the package;
detector and stability are those of WEIGHTS to the bit, as are the ranges for int8. With --control the pairs are views
of single frames under homographies.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2

from improvo.frontend.weights_files import find_weights
from improvo.training.data.pack import read_pack
from improvo.training.metric_training import train_metric
from improvo.training.stages.descriptor_metric import MetricSettings


def main() -> None:
    """Make the weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pack", type=Path)
    parser.add_argument("weights", help="a file, or a bundled name")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--pairs", type=int, default=3000, help="of frames")
    parser.add_argument("--shrinkage", type=float, default=MetricSettings.shrinkage, help="see MetricSettings")
    parser.add_argument("--control", action="store_true", help="homographies of single frames in place of pairs")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    _, posed, data = read_pack(arguments.pack)
    settings = MetricSettings(
        pairs=arguments.pairs, shrinkage=arguments.shrinkage, two_frames=not arguments.control, views_per_frame=1
    )
    print(train_metric(posed, settings, arguments.output, find_weights(arguments.weights), data))


if __name__ == "__main__":
    main()
