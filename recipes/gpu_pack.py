"""Pack what the bundled weights are trained on into one file: python recipes/gpu_pack.py PICTURES ROOMS -o pack.zip

PICTURES is a folder of image folders, sequences and folders of videos; SOURCES says which of them are taken, and how
many of their pictures. ROOMS holds recordings of `improvo simulate` with depth, 640x480; the labels of what moves keep
its depth out. With --depth FOLDER, sequences of PICTURES that have `FOLDER/NAME.npz` (made with their true poses:
`frames` (N,), `inverse_depth` (N, h, w), `K` and `world_from_cam`) are packed as posed sequences too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from improvo.cli.train_options import read_data_card
from improvo.simulation.causes import Cause
from improvo.training.data.pack import write_pack
from improvo.training.data.pictures import Pictures, Source, load_pictures
from improvo.training.data.posed_sequence import PosedSequence, block_inverse_depth

HERE = Path(__file__).parent
# folder or video of PICTURES -> (every so manieth picture, weight beside the square root of the number)
SOURCES = {
    "icl-office-kt0-a": (6, 0.7),
    "icl-office-kt0-b": (6, 0.7),
    "icl-office-kt3": (10, 0.7),
    "lab-floor-realsense": (4, 1.0),
    "photos": (1, 2.0),
    "road-a": (8, 0.5),
    "static-bottles": (18, 1.0),
    "static-person-room": (15, 1.0),
    "tartanair-hospital": (3, 1.0),
    "tum-fr3-cabinet": (1, 1.0),
    "gopro": (8, 3.0),
    "hand-object": (40, 2.0),
    "static-robots": (150, 2.0),
}
PANORAMAS = (2, 0.7)
VIDEOS = (".mp4", ".avi", ".mov")


def pictures_of(folder: Path, stride: int, weight: float, longer_side: int) -> Source:
    """Every so manieth picture of an image folder or of each video in a folder, as one source."""
    videos = sorted(file for file in folder.iterdir() if file.suffix.lower() in VIDEOS)
    if videos:
        pictures = [picture for video in videos for picture in video_pictures(video, stride, longer_side)]
        return Source(folder.name, tuple(pictures), ("",) * len(pictures), weight * len(pictures) ** 0.5)
    source = load_pictures([str(folder)], longer_side).sources[0]
    taken = source.pictures[::stride]
    rotating = None if source.rotating is None else source.rotating[::stride]
    return Source(source.name, taken, source.names[::stride], weight * len(taken) ** 0.5, rotating)


def video_pictures(path: Path, stride: int, longer_side: int) -> list[np.ndarray]:
    """Every so manieth frame of a video, grey, at most of that size."""
    video, pictures, number = cv2.VideoCapture(str(path)), [], 0
    while video.grab():
        if number % stride == stride // 2:
            grey = cv2.cvtColor(video.retrieve()[1], cv2.COLOR_BGR2GRAY)
            scale = min(1.0, longer_side / max(grey.shape))
            pictures.append(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
        number += 1
    return pictures


def room(folder: Path, least_step: float) -> PosedSequence:
    """A simulated recording, thinned to a frame every `least_step` seconds; what moves has no depth."""
    camera = yaml.safe_load((folder / "camera.yaml").read_text())
    K = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]])
    rows = np.loadtxt(folder / "groundtruth.txt")
    stride = max(1, round(least_step * camera["fps"]))
    numbers = range(0, len(rows), stride)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]
    pictures, depths = [], []
    for number in numbers:
        image, label, depth = (
            cv2.imread(str(folder / f"{kind}/{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            for kind in ("rgb", "labels", "depth")
        )
        pictures.append(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
        static = label != Cause.MOVING
        depths.append(block_inverse_depth(np.where(static, depth / camera["depth_scale"], 0.0)))
    return PosedSequence(folder.name, tuple(pictures), rows[::stride, 0], K, poses[::stride], tuple(depths))


def swept(folder: Path, file: Path) -> PosedSequence:
    """A sequence of PICTURES with depth maps that were made for some of its frames."""
    found = np.load(file)
    images = sorted(folder.glob("*.jpg"))
    pictures = tuple(cv2.imread(str(images[number]), cv2.IMREAD_GRAYSCALE) for number in found["frames"])
    depths = tuple(values.astype(np.float32) for values in found["inverse_depth"])
    return PosedSequence(folder.name, pictures, found["times"], found["K"], found["world_from_cam"], depths)


def main() -> None:
    """Pack."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("rooms", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--depth", type=Path, help="depth maps of sequences of PICTURES")
    parser.add_argument("--data-card", type=Path, default=HERE / "gpu-data.json", help="licences of all of it")
    parser.add_argument("--longer-side", type=int, default=640)
    parser.add_argument("--room-step", type=float, default=1 / 3, help="seconds between the frames taken of a room")
    parser.add_argument("--most-rooms", type=int, default=1000)
    parser.add_argument("--quality", type=int, default=75, help="of WebP")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    wanted = dict(SOURCES)
    wanted |= {folder.name: PANORAMAS for folder in sorted(arguments.pictures.glob("pan-*"))}
    sources = [
        pictures_of(arguments.pictures / name, stride, weight, arguments.longer_side)
        for name, (stride, weight) in wanted.items()
        if (arguments.pictures / name).is_dir()
    ]
    folders = sorted(path.parent for path in arguments.rooms.glob("*/groundtruth.txt"))
    # rooms of all kinds, whichever are finished: their last depth image is there
    finished = [folder for folder in folders if (folder / "done").exists() or (folder / "rgb.txt").exists()]
    posed = [room(folder, arguments.room_step) for folder in finished[: arguments.most_rooms]]
    if arguments.depth:
        posed += [swept(arguments.pictures / file.stem, file) for file in sorted(arguments.depth.glob("*.npz"))]
    data = read_data_card(arguments.data_card)
    write_pack(arguments.output, Pictures(tuple(sources)), posed, data, arguments.quality)
    for source in sources:
        print(f"{source.name}: {len(source.pictures)} pictures, weight {source.weight:.1f}")
    frames = sum(len(sequence.pictures) for sequence in posed)
    size = arguments.output.stat().st_size / 2**20
    print(f"{len(posed)} posed sequences of {frames} frames; {arguments.output}: {size:.1f} MiB")


if __name__ == "__main__":
    main()
