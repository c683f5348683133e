"""Every parser with a small valid example, for the fuzzer (benchmarks/fuzz.py) and for the corpus that it left."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import sequence_encoders as encoders
from camera_notations import FILE_STORAGE, FX_TO_CY
from improvo.errors import ImprovoError
from improvo.sequences import open_sequence
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.images import read_depth, read_image
from sequence_builders import CAMERA, depths, images, poses, write_video
from sequence_encoders import Scene

EXPECTED = (ImprovoError, UnreadableFrameError)  # what a parser may raise


@dataclass(frozen=True)
class Target:
    """A parser.

    Args:
        write: makes a valid example in an empty folder; returns the file to damage.
        read: reads it, given the file.
        text: the example is text, whose words are worth exchanging.
    """

    write: Callable[[Path], Path]
    read: Callable[[Path], Any]
    text: bool = False


def scene(count: int = 3) -> Scene:
    """A small recording."""
    return Scene(CAMERA, 10.0 + np.arange(count) * 0.25, images(count), depths(count), poses(count))


def read_recording(path: Path, root: int = 0) -> None:
    """Open the recording that the damaged file belongs to, `root` folders up, and read all of it."""
    for _ in range(root):
        path = path.parent
    sequence = open_sequence(path, camera="90,91,47,36.5")
    frames = list(sequence)
    assert len(frames) + len(sequence.skipped) == len(sequence), "a frame is neither read nor skipped"
    for row in range(min(len(sequence), 3)):
        sequence.depth(row)
    truth = sequence.ground_truth
    assert truth is None or len(truth) == len(sequence), "a true pose for each frame"
    assert sequence.recording.calibration is None or sequence.recording.calibration.intrinsics[0] > 0


def _bytes(name: str, content: bytes) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return write


def _encoded(suffix: str, deep: bool = False) -> Callable[[Path], Path]:
    image = images(1)[0].astype(np.uint16) * 256 if deep else images(1)[0]
    return _bytes(f"x{suffix}", cv2.imencode(suffix, image)[1].tobytes())


def _file(name: str, write: Callable[[Path], object]) -> Callable[[Path], Path]:
    """A recording written by one of the encoders, of which the file `name` is damaged."""

    def made(folder: Path) -> Path:
        write(folder / name.split("/", 1)[0])
        return folder / name

    return made


def _with_groundtruth(folder: Path) -> None:
    encoders.write_image_folder(folder, scene())
    (folder / "groundtruth.txt").write_text("".join(f"{10 + i / 4} {i} 0 0 0 0 0 1\n" for i in range(3)))


def _picture_targets() -> dict[str, Target]:
    kinds = [".png", ".jpg", ".tif", ".bmp", ".webp", ".pgm", ".jp2"]
    targets = {f"image{kind}": Target(_encoded(kind), read_image) for kind in kinds}
    targets["image-deep.png"] = Target(_encoded(".png", deep=True), read_image)
    targets["depth.png"] = Target(_encoded(".png", deep=True), partial(read_depth, scale=1000.0))
    return targets


def _recording_targets() -> dict[str, Target]:
    import ros_encoders

    def bag(version: int, storage: str = "sqlite3") -> Callable[[Path], object]:
        return lambda path: ros_encoders.write_bag(path, scene(), version, storage=storage)

    rows: list[tuple[str, Callable[[Path], object], int]] = [
        ("s.sens", lambda path: encoders.write_sens(path, scene()), 0),
        ("s.bag", bag(1), 0),
        ("ros2/ros2.db3", bag(2), 1),
        ("ros2/metadata.yaml", bag(2), 1),
        ("mcap/mcap.mcap", bag(2, "mcap"), 1),
        ("s.r3d", lambda path: encoders.write_r3d(path, scene()), 0),
        ("n/transforms.json", lambda path: encoders.write_transforms(path, scene()), 1),
        ("tum/rgb.txt", lambda path: encoders.write_tum(path, scene()), 1),
        ("tum/groundtruth.txt", lambda path: encoders.write_tum(path, scene()), 1),
        ("kitti/calib.txt", lambda path: encoders.write_kitti(path, scene()), 1),
        ("euroc/mav0/cam0/data.csv", lambda path: encoders.write_euroc(path, scene(), np.eye(4)), 3),
        ("euroc/mav0/cam0/sensor.yaml", lambda path: encoders.write_euroc(path, scene(), np.eye(4)), 3),
        ("folder/camera.yaml", lambda path: encoders.write_image_folder(path, scene()), 1),
        ("folder/times.txt", lambda path: encoders.write_image_folder(path, scene()), 1),
        ("folder/groundtruth.txt", _with_groundtruth, 1),
        ("v.avi", lambda path: write_video(path, images(4)), 0),
        ("v.mp4", lambda path: write_video(path, images(4), codec="mp4v"), 0),
    ]
    texts = (".txt", ".json", ".yaml", ".csv")
    packed = Target(_packed_bag, partial(read_recording, root=1))
    return {"packed/packed.db3.zstd": packed} | {
        name: Target(_file(name, write), partial(read_recording, root=root), name.endswith(texts))
        for name, write, root in rows
    }


def _text_targets() -> dict[str, Target]:
    from improvo import config
    from improvo.continuation import SettingsRecord
    from improvo.geometry.camera_files import load_calibration
    from improvo.geometry.trajectory_files import read_times, read_trajectory
    from improvo.odometry.run_settings import RunSettings

    def calibration(path: Path) -> None:
        load_calibration(str(path))

    opencv = FILE_STORAGE.format(fisheye=0, count=4, distortion="[ -0.28, 0.07, 0.0002, 1.7e-05 ]")
    cameras = {
        "camera.yaml": f"model: pinhole\nwidth: 752\nheight: 480\n{FX_TO_CY.format('')}distortion: []\n",
        "opencv.yaml": opencv,
        "camera.json": json.dumps({"fx": 458.6, "fy": 457.3, "cx": 367, "cy": 248, "k1": -0.2, "w": 752, "h": 480}),
        "camera.xml": "<?xml version='1.0'?><opencv_storage><camera_matrix><rows>3</rows><cols>3</cols><data>"
        "400 0 376 0 400 240 0 0 1</data></camera_matrix></opencv_storage>",
        "camera.ini": "[LEFT_CAM_HD]\nfx=400\nfy=400\ncx=376\ncy=240\nk1=0.1\nk2=0.01\np1=0\np2=0\n",
        "cameras.txt": "# Camera list\n1 OPENCV 752 480 458.6 457.3 367.2 248.4 -0.28 0.07 0.0002 0.00002\n",
    }
    targets = {name: Target(_bytes(name, text.encode()), calibration, True) for name, text in cameras.items()}
    trajectories = {
        "tum-trajectory.txt": "# timestamp\n" + "".join(f"{i / 10} {i} 0 0 0 0 0 1\n" for i in range(5)),
        "kitti-trajectory.txt": "1 0 0 1 0 1 0 2 0 0 1 3\n" * 4,
        "euroc-trajectory.csv": "".join(f"14036365797635555{i:02d},1,2,3,1,0,0,0,0,0,0\n" for i in range(4)),
    }
    targets |= {name: Target(_bytes(name, text.encode()), read_trajectory, True) for name, text in trajectories.items()}
    targets["times.txt"] = Target(_bytes("times.txt", b"0 0.1\n1 0.2\n2 0.3\n"), read_times, True)
    settings = config.to_yaml(RunSettings()).encode()
    targets["run.yaml"] = Target(
        _bytes("run.yaml", settings), lambda path: config.load(RunSettings, path) and None, True
    )
    targets["settings.yaml"] = Target(
        _bytes("settings.yaml", settings), lambda path: SettingsRecord(path, RunSettings).difference({}), True
    )
    return targets


def _archive_targets() -> dict[str, Target]:
    from improvo.evaluation.frontends.exported import _read_hdf5, _read_npz, to_features
    from improvo.evaluation.pose.cache import read_cache, write_cache
    from improvo.frontend.importing import read_public_file
    from improvo.frontend.weights_files import load_weights, save_weights
    from improvo.geometry.camera_files import load_calibration
    from improvo.training.data.point_labels import PointLabels, load_labels, save_labels
    from improvo.types import Features
    from network_examples import random_weights

    rng = np.random.default_rng(0)
    features = Features(rng.uniform(0, 90, (5, 2)).astype(np.float32), np.eye(5, 8, dtype=np.float32), np.ones(5, "f4"))
    arrays = {"keypoints": features.keypoints, "descriptors": features.descriptors, "scores": features.scores}
    weights = random_weights()

    def npz(folder: Path) -> Path:
        np.savez(folder / "x.npz", **arrays)
        return folder / "x.npz"

    def camera(folder: Path) -> Path:
        np.savez_compressed(folder / "c.npz", mtx=np.diag([400.0, 400.0, 1.0]) + 0.0, dist=np.zeros(5))
        return folder / "c.npz"

    def hdf5(folder: Path) -> Path:
        import h5py

        with h5py.File(folder / "x.h5", "w") as file:
            for name, values in arrays.items():
                file[f"a.png/{name}"] = values.T if name == "descriptors" else values
        return folder / "x.h5"

    def cache(name: str, folder: Path) -> Path:
        write_cache(folder / "cache", {"frontend": "x"}, {0: features, 7: features})
        return folder / "cache" / name

    def labels(folder: Path) -> Path:
        save_labels(folder / "l.npz", [[PointLabels(features.keypoints, features.scores)]])
        return folder / "l.npz"

    def saved(folder: Path) -> Path:
        save_weights(folder / "w.safetensors", weights.tensors, weights.card)
        return folder / "w.safetensors"

    def public(folder: Path) -> Path:
        import torch

        torch.save({name: torch.from_numpy(values) for name, values in weights.tensors.items()}, folder / "w.pth")
        return folder / "w.pth"

    def read_cache_of(path: Path) -> None:
        cached = read_cache(path.parent, {"frontend": "x"})
        if cached is not None:
            _ = [cached[frame] for frame in cached.rows]

    targets = {
        "features.npz": Target(npz, lambda path: to_features(_read_npz(path), str(path), (96, 72))),
        "camera.npz": Target(camera, lambda path: load_calibration(str(path))),
        "labels.npz": Target(labels, lambda path: load_labels(path, [1])),
        "weights.safetensors": Target(saved, load_weights),
        **{
            f"cache-{name}": Target(partial(cache, name), read_cache_of, name.endswith("json"))
            for name in ("index.json", "keypoints.npy", "descriptors.npy", "scores.npy")
        },
    }
    try:
        import h5py  # noqa: F401

        targets["features.h5"] = Target(hdf5, lambda path: to_features(_read_hdf5(str(path), "a.png"), "x", (96, 72)))
    except ImportError:
        pass
    try:
        import torch  # noqa: F401

        targets["public.pth"] = Target(public, read_public_file)
    except ImportError:
        pass
    return targets


def _packed_bag(folder: Path) -> Path:
    """A ROS 2 bag whose database is packed as a file."""
    try:
        from compression import zstd
    except ImportError:
        from backports import zstd
    import ros_encoders

    bag = ros_encoders.write_bag(folder / "packed", scene(), 2)
    database = bag / "packed.db3"
    packed = database.with_name("packed.db3.zstd")
    packed.write_bytes(zstd.compress(database.read_bytes()))
    database.unlink()
    text = (bag / "metadata.yaml").read_text().replace("packed.db3", "packed.db3.zstd")
    text = text.replace("compression_format: ''", "compression_format: zstd")
    text = text.replace("compression_mode: ''", "compression_mode: FILE")
    (bag / "metadata.yaml").write_text(text)
    return packed


def _training_targets() -> dict[str, Target]:
    """Files of a training; none where torch is not installed."""
    try:
        from training_examples import tiny_trainer
    except ImportError:
        return {}
    from improvo.training.data.pack import read_pack, write_pack
    from improvo.training.data.pictures import Pictures, Source
    from improvo.training.data.posed_sequence import PosedSequence
    from improvo.training.metrics import METRICS, keep_metrics
    from improvo.training.trainer import Trainer

    def checkpoint(folder: Path) -> Path:
        tiny_trainer(folder).run(progress=False)
        return folder / "checkpoint.pt"

    def pack(folder: Path) -> Path:
        pictures = tuple(images(2))
        depth = tuple(np.full(one.shape, 0.5, np.float32) for one in pictures)
        times, poses_ = np.arange(2.0), np.tile(np.eye(4), (2, 1, 1))
        posed = PosedSequence("room", pictures, times, np.diag([90.0, 91.0, 1.0]), poses_, depth)
        source = Source("pictures", pictures, ("a", "b"), 1.0, None)
        write_pack(folder / "pack.zip", Pictures((source,)), [posed], [])
        return folder / "pack.zip"

    @cache
    def trainer(folder: Path) -> Trainer:
        return tiny_trainer(folder)

    return {
        "checkpoint.pt": Target(checkpoint, lambda path: trainer(path.parent).resume()),
        "metrics.jsonl": Target(
            lambda folder: checkpoint(folder).with_name(METRICS), lambda path: keep_metrics(path, 1), True
        ),
        "pack.zip": Target(pack, read_pack),
    }


def _pose_results(folder: Path) -> Path:
    """A `pose.json` of `improvo evaluate pose`, of one frontend, solver and gap."""
    from improvo.config import to_dict
    from improvo.evaluation.settings import PoseSettings

    settings = to_dict(PoseSettings(gaps=(5,), estimators=("opencv",)))
    head = {"frontend": "orb", "estimator": "opencv", "gap": 5}
    names = ("rotation_success", "translation_success", "pose_success", "rotation_auc", "translation_auc")
    names += ("repeatability", "precision", "keypoints", "matches", "judged_matches", "right_matches", "inliers")
    names += ("inlier_share", "right_share_3px", "right_share_8px")
    row = {**head, "pairs": 4, "failures": 0, "median_rotation_deg": 1.0, "median_translation_m": 0.1}
    row |= dict.fromkeys(names, 0.5) | {f"{name}_interval": [0.25, 0.75] for name in names}
    curve = {"rotation_deg": [0.0, 1.0], "rotation_accuracy": [0.0, 0.5]}
    curve |= {"translation_m": [0.0, 0.1], "translation_accuracy": [0.0, 0.5]}
    sequence = {"name": "room", "frames": 9, "pairs": {"5": 4}, "invalid_poses": 0, "unreadable_frames": 0}
    content = {
        "protocol": "pose", "settings": settings, "frontends": ["orb"], "rows": [row], "differences": [],
        "sequences": [sequence], "sequence_rows": [{"sequence": "room", **row}], "curves": [{**head, **curve}],
        "gaps": [{"gap": 5, "pairs": 4, "mean_rotation_deg": 3.0, "mean_translation_m": 0.1}],
    }  # fmt: skip
    (folder / "pose.json").write_text(json.dumps(content))
    return folder / "pose.json"


def _read_pose_results(path: Path) -> None:
    from improvo.cli.evaluate_pose import read_results
    from improvo.evaluation.pose.tables import pose_tables

    pose_tables(read_results(path))


def _own_targets() -> dict[str, Target]:
    """Folders that improvo wrote and somebody touched."""
    from improvo.depth.archive import DepthReader, DepthWriter
    from improvo.files import check_output_folder, make_output_folder
    from improvo.improvement.split import Part, Split, remembered_split
    from improvo.improvement.validation import GapScores, Validation, read_validation, write_validation
    from improvo.labeling.frames import FRAMES_FILE, FramesTable, PackedImages, pack_images, read_frames, write_frames
    from improvo.labeling.labeled import read_labels
    from improvo.odometry.run.map_file import read_map, write_map
    from improvo.odometry.run.run_folder import RunFolder
    from improvo.odometry.run.run_json import why_no_pose
    from improvo.sequences import SequenceSettings
    from improvo.stability.tables import (
        POINTS_FILE,
        TRACKS_FILE,
        PointsTable,
        PointsWriter,
        TracksWriter,
        read_points,
        read_tracks,
    )
    from improvo.types import SparseMap
    from labeled_scene import write_labeled_scene

    def store(name: str, folder: Path) -> Path:
        return write_labeled_scene(folder / "labels", frames=4, every=40) / name

    def read_store(path: Path) -> None:
        for one in read_labels(next(parent for parent in path.parents if parent.name == "labels")):
            _ = one.camera, one.tracks, one.points, one.frames, one.cam_from_world, one.image(0)

    def short_table(name: str, folder: Path) -> Path:
        """Each table of a label store with three rows, for its own reader."""
        frames, track = np.arange(3), np.zeros(3, np.int64)
        ones, yes = np.ones(3), np.ones(3, np.bool_)
        write_frames(folder / FRAMES_FILE, FramesTable(frames, frames, ones, track, yes))
        with PointsWriter(folder / POINTS_FILE) as points:
            points.write(PointsTable(frames, frames, np.ones((3, 3)), ones, ones, ones, yes + 0, track, ones, yes))
        with TracksWriter(folder / TRACKS_FILE) as tracks:
            tracks.write(frames, track, np.ones((3, 2), np.float32), ones, ones)
        pack_images(folder, [(image, None) for image in images(2)])
        return folder / name

    def read_packed(path: Path) -> None:
        packed = PackedImages(path.parent)
        _ = packed.image(0), packed.mask(0), packed.image(1)

    def ply(folder: Path) -> Path:
        ints = np.arange(4)
        write_map(folder / "map.ply", SparseMap(ints, np.ones((4, 3)), ints, np.ones(4), np.ones(4), ints))
        return folder / "map.ply"

    def split(folder: Path) -> Path:
        part = Part((Path("/nowhere"),), SequenceSettings())
        remembered_split(folder / "split.json", lambda: Split(part, part, "words"))
        return folder / "split.json"

    def judgement(folder: Path) -> Path:
        scores = GapScores("room", 0, 30, 1.0, [[0, 30], [4, 34]], [50, 40], {"right_8px": [0.5, 0.25]})
        labels, seconds = {"stable": 3, "unstable": 1, "ignore": 2}, {"label": 1.0, "evaluate": 2.0}
        write_validation(
            folder / "judgement.json", Validation(9, 9, 1, 3.0, 0.9, 0.4, labels, (scores,), seconds=seconds)
        )
        return folder / "judgement.json"

    def marker(folder: Path) -> Path:
        make_output_folder(folder / "out", "run")
        return folder / "out" / ".improvo.json"

    def depth(folder: Path) -> Path:
        with DepthWriter(folder / "depth.zip", np.eye(3)) as maps:
            maps.write(0, np.ones((6, 8), np.float32))
        return folder / "depth.zip"

    def run_folder(folder: Path) -> Path:
        camera = {"width": 96, "height": 72, "fx": 90.0, "fy": 91.0, "cx": 47.0, "cy": 36.5}
        frames = {"source_index": [0, 2, 4], "tracked": 2, "processed": 3, "lost_frames": [0]}
        events = [{"kind": "initialising", "frame_index": 0, "detail": "too little parallax"}]
        report = {"input": {"path": "/nowhere"}, "camera": camera, "frames": frames, "events": events}
        (folder / "run.json").write_text(json.dumps({**report, "configuration": {"sequence": {"stride": 2}}}))
        (folder / "trajectory.txt").write_text("0.1 0 0 0 0 0 0 1\n0.2 1 0 0 0 0 0 1\n")
        return folder / "run.json"

    def read_run(path: Path) -> None:
        run = RunFolder(path.parent)
        _ = run.name, run.frames, run.camera, run.trajectory, run.frame_indices, why_no_pose(run.report)
        with suppress(ImprovoError):
            _ = run.sequence

    names = ("label.json", "run.json", "tracks.parquet", "points.parquet", "frames.parquet", "trajectory.txt")
    targets = {
        f"store-{name}": Target(partial(store, f"walls/{name}"), read_store, text=name.endswith((".json", ".txt")))
        for name in (*names, "images-00000.parquet")
    }
    readers = {"tracks": read_tracks, "points": read_points, "frames": read_frames, "images-00000": read_packed}
    targets |= {
        f"{name}.parquet": Target(partial(short_table, f"{name}.parquet"), read) for name, read in readers.items()
    }
    targets["store-settings.yaml"] = Target(partial(store, "settings.yaml"), read_store, True)
    targets["run.json"] = Target(run_folder, read_run, True)
    targets["map.ply"] = Target(ply, read_map)
    targets["split.json"] = Target(split, lambda path: remembered_split(path, _unreachable), True)
    targets["judgement.json"] = Target(judgement, lambda path: asdict(read_validation(path)), True)
    targets["marker"] = Target(marker, lambda path: check_output_folder(path.parent, "run"), True)
    targets["pose.json"] = Target(_pose_results, _read_pose_results, True)
    targets["depth.zip"] = Target(depth, lambda path: DepthReader(path).depth(0))
    return targets


def _unreachable() -> Any:
    raise AssertionError("the file is there")


def targets() -> dict[str, Target]:
    """All parsers, by a name that says what is damaged."""
    groups = (_picture_targets, _recording_targets, _text_targets, _archive_targets, _own_targets, _training_targets)
    return {name: target for group in groups for name, target in group().items()}
