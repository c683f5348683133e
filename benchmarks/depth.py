"""Dense depth of frames against depth images and true poses, and the correspondences that follow from it.

    python benchmarks/depth.py                                    # every recording, true and own poses; half an hour
    python benchmarks/depth.py room-home/truth redkitchen/own --frames 200
    python benchmarks/depth.py room-home --set refine.steps=0     # one setting changed, to compare

First table: share of the pixels with a depth, relative error (median, share over 5 %) under one scale for the whole
recording and under one for each frame, time of a frame, and that time as a multiple of SIFT's on the same frame. Second
table, frames so far apart, at pixels where both maps agree to 5 %: distance to where the depth image and the true poses
put the pixel (median, share over 8 px), and at SIFT matches the median distance of the match from the correspondence of
the maps and from that of the truth. SIFT knows neither: the smaller distance is the better correspondence. Third table,
with `--aligned` (needs torch): at corners that both maps show, how many the pictures confirm and contradict when
patches are laid over each other, how far the maps and the truth put them from where the pictures agree, and distance
to the truth before and after they are moved there.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from depth_alignment import aligned_correspondences
from depth_cases import Case, cases
from depth_measures import Maps, accuracy, correspondences
from improvo import config
from improvo.depth import DepthSettings
from improvo.depth.compile import compile_depth
from improvo.depth.depth_maps import depth_maps

TIMED_EVERY = 10  # frames, for SIFT


def swept(case: Case, settings: DepthSettings) -> tuple[Maps, float, float]:
    """All depth maps, and the processor time of a frame: of its depth, and of SIFT."""
    sift = cv2.SIFT_create(1000)
    images = {}

    def image(frame: int) -> np.ndarray:
        start = time.thread_time()
        images[frame] = case.sequence[frame].image
        reading[0] += time.thread_time() - start
        return images[frame]

    maps: Maps = {}
    reading, sift_seconds = [0.0], []
    start = time.thread_time()
    for frame, depth_map in depth_maps(
        image, case.cam_from_world, case.segment, case.sequence.camera.K, case.ranges, settings
    ):
        maps[frame] = depth_map
        own_image = images.pop(frame)
        if frame % TIMED_EVERY == 0:
            before = time.thread_time()
            sift.detectAndCompute(own_image, None)
            sift_seconds.append(time.thread_time() - before)
    spent = time.thread_time() - start - reading[0] - sum(sift_seconds)
    return maps, spent / max(len(maps), 1), float(np.mean(sift_seconds))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", help="such as redkitchen/own or room-easy/truth (default: all)")
    parser.add_argument("--frames", type=int, help="at most so many of each recording")
    parser.add_argument("--every", type=int, default=10, help="pairs start at every n-th frame")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of depth")
    parser.add_argument("--aligned", action="store_true", help="also what the pictures make of the correspondences")
    parser.add_argument("--runs", type=Path, help="keep rendered rooms and runs here, and use them again")
    arguments = parser.parse_args()
    settings = config.load(DepthSettings, overrides=arguments.set)
    cv2.setNumThreads(1)
    compile_depth()
    with tempfile.TemporaryDirectory() as temporary:
        runs = arguments.runs or Path(temporary)
        runs.mkdir(parents=True, exist_ok=True)
        print("| recording/poses | frames | known | median, % | over 5 % | per frame | over 5 % | ms | x SIFT |")
        print("|---|---|---|---|---|---|---|---|---|")
        rows, moved = [], []
        for case in cases(arguments.cases, runs, arguments.frames):
            maps, seconds, sift_seconds = swept(case, settings)
            a = accuracy(case, maps)
            print(
                f"| `{case.name}` | {len(maps)} | {a.known:.3f} | {100 * a.median:.2f} | {a.far_off:.3f} | "
                f"{100 * a.frame_median:.2f} | {a.frame_far_off:.3f} | {1000 * seconds:.0f} | "
                f"{seconds / sift_seconds:.2f} |",
                flush=True,
            )
            every = 1 if case.gaps[0] == 1 else arguments.every
            rows += [(case.name, found) for gap in case.gaps if (found := correspondences(case, maps, gap, every))]
            gaps = case.gaps if arguments.aligned else ()
            moved += [(case.name, found) for gap in gaps if (found := aligned_correspondences(case, maps, gap, every))]
    print()
    print("| recording/poses | frames apart | pixels | median, px | over 8 px | matches | own, px | truth, px |")
    print("|---|---|---|---|---|---|---|---|")
    for name, c in rows:
        print(
            f"| `{name}` | {c.gap} | {c.pixels:.3f} | {c.median:.2f} | {c.far_off:.3f} | {c.matches} | "
            f"{c.own_to_match:.2f} | {c.truth_to_match:.2f} |"
        )
    if moved:
        print()
        print("| recording/poses | apart | seen | confirmed | elsewhere | own, px | truth, px | to truth | over 8 px |")
        print("|---|---|---|---|---|---|---|---|---|")
    for name, m in moved:
        print(
            f"| `{name}` | {m.gap} | {m.visible:.3f} | {m.certain:.3f} | {m.contradicted:.3f} | "
            f"{m.own_to_picture:.2f} | {m.truth_to_picture:.2f} | {m.before:.2f} -> {m.after:.2f} | "
            f"{m.far_before:.3f} -> {m.far_after:.3f} |"
        )


if __name__ == "__main__":
    main()
