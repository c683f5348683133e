"""The bundled weights, from pictures to model card: python recipes/superpoint.py PICTURES... -o OUT

Needs torch, NumPy, OpenCV and improvo itself; runs on a CPU or a GPU (torchrun for several processes), and continues
where it was stopped. Three trainings, all of them `improvo train homographies`:

1. small: half width from scratch at a constant learning rate; detector labels are Shi-Tomasi corners under homographic
   adaptation. Half width sees three times as many pictures in the same time, when there is most to learn.
2. small again: the learning rate falls to zero. This is `superpoint-small`.
3. full: the small network widened behind its first four layers, which computes the same, and trained on. The first four
   keep the 32 channels of the small one and leave the paper's other 32 at zero: at full and half resolution they would
   cost three fifths of all time, in training and after. This is `superpoint`.

With --round, the pictures are labeled anew by the network of step 2 before step 3 (homographic adaptation proper).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from improvo.cli.train_options import read_data_card
from improvo.errors import ImprovoError
from improvo.training.distributed import Process
from improvo.training.settings import HomographiesSettings
from improvo.training.superpoint_training import train_homographies

HERE = Path(__file__).parent


def main() -> int:
    """Run the recipe."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="PICTURES[=WEIGHT]", help="image folders or sequences")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument(
        "--data-card", type=Path, default=HERE / "superpoint-data.json", help="licences of the pictures"
    )
    parser.add_argument("--small-steps", type=int, default=1600)
    parser.add_argument("--small-decay", type=int, default=300, help="the last of the small steps")
    parser.add_argument("--full-steps", type=int, default=9000)
    parser.add_argument("--stem", type=int, default=32, help="channels of the first four layers that are used; 0: all")
    parser.add_argument("--batch-size", type=int, default=8, help="pairs; 64 and more on a GPU")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="data processes; a GPU wants 8 and more")
    parser.add_argument("--round", action="store_true", help="label the pictures with the small network before step 3")
    arguments = parser.parse_args()
    data = read_data_card(arguments.data_card)
    defaults = HomographiesSettings()
    optimiser = replace(
        defaults.optimiser, batch_size=arguments.batch_size, device=arguments.device, threads=arguments.threads,
        workers=arguments.workers,
    )  # fmt: skip
    small_folder, full_folder = arguments.output / "superpoint-small", arguments.output / "superpoint"

    constant = arguments.small_steps - arguments.small_decay
    small = replace(defaults, architecture="superpoint-small")
    for steps, decay in ((constant, 1), (arguments.small_steps, arguments.small_decay)):
        settings = replace(small, optimiser=replace(optimiser, steps=steps, decay_steps=decay))
        train_homographies(arguments.sources, settings, small_folder, data=data)

    small_weights = small_folder / "weights.safetensors"
    steps = arguments.full_steps
    falling = replace(optimiser, steps=steps, decay_steps=steps // 6, seed=7)
    full = replace(defaults, stem_channels=arguments.stem, views=replace(defaults.views, rotation_degrees=30.0))
    train_homographies(
        arguments.sources,
        replace(full, optimiser=falling),
        full_folder,
        start=small_weights,
        detector=small_weights if arguments.round else None,
        data=data,
    )
    if Process.current().leads:
        print(f"superpoint-small: {small_weights}\nsuperpoint: {full_folder / 'weights.safetensors'}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ImprovoError as error:
        sys.exit(f"recipe: {error}")
