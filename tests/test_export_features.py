"""Features and matches for hloc and COLMAP: half a pixel, shapes, pairs, and a reconstruction of the true path."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from rendered_walk import CAMERA, write_walk
from simulated_features import hand_motion

from improvo.cli.main import main
from improvo.export.features import partners
from improvo.frontend.masking import features_of
from improvo.frontend.registry import load_frontend
from improvo.geometry.alignment import align_points
from improvo.sequences import open_sequence
from improvo.tracking.matching import mutual_nearest_neighbours

FRAMES = 16
OPTIONS = ["--frontend", "sift", "--max-keypoints", "500"]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk", frames=FRAMES)


def export(walk: Path, folder: Path, layout: str, *more: str) -> None:
    words = ["export", "features", str(walk), "--layout", layout, "-o", str(folder), *OPTIONS, *more]
    assert main(words) == 0


def test_partners_are_the_window_and_the_loops() -> None:
    assert partners(0, 3, 4) == []
    assert partners(2, 3, 0) == [0, 1]
    assert partners(9, 3, 0) == [6, 7, 8]
    assert partners(12, 3, 4) == [0, 4, 8, 9, 10, 11]
    assert partners(13, 3, 4) == [10, 11, 12]


def test_hloc_reads_its_keypoints_descriptors_and_matches(walk: Path, tmp_path: Path, capsys) -> None:
    h5py = pytest.importorskip("h5py", reason="needs h5py: pip install 'improvo[hdf5]'")
    export(walk, tmp_path / "out", "hloc", "--window", "2", "--loop-every", "5", "--descriptors", "float32")
    assert f"{FRAMES} images" in capsys.readouterr().out
    sequence, frontend = open_sequence(walk), load_frontend("sift", 500)
    expected = [features_of(frontend, frame) for frame in sequence]
    pairs = [line.split() for line in (tmp_path / "out" / "pairs.txt").read_text().splitlines()]
    assert ["000000.png", "000001.png"] in pairs
    assert ["000005.png", "000010.png"] in pairs
    assert ["000004.png", "000010.png"] not in pairs
    with h5py.File(tmp_path / "out" / "features.h5", "r", libver="latest") as file:
        for number, features in enumerate(expected):
            group = file[f"{number:06d}.png"]
            np.testing.assert_array_equal(group["keypoints"], features.keypoints)  # the centre of a pixel is whole
            assert group["descriptors"].shape == (128, len(features))
            np.testing.assert_allclose(np.linalg.norm(group["descriptors"], axis=0), 1, atol=1e-5)
            assert group["image_size"][()].tolist() == [CAMERA.width, CAMERA.height]
            assert group["keypoints"].attrs["uncertainty"] > 0
            assert (np.diff(group["scores"]) <= 0).all()
    with h5py.File(tmp_path / "out" / "matches.h5", "r", libver="latest") as file:
        found = file["000003.png/000005.png"]["matches0"][()]
        rows = np.flatnonzero(found >= 0)
        ours = mutual_nearest_neighbours(expected[3], expected[5], 0.7)
        np.testing.assert_array_equal(np.stack([rows, found[rows]], axis=1), ours)
        assert len(file["000003.png/000005.png"]["matching_scores0"]) == len(expected[3])
    model, width, height, *numbers = (tmp_path / "out" / "intrinsics.txt").read_text().splitlines()[3].split()[1:]
    assert (model, int(width), int(height)) == ("PINHOLE", CAMERA.width, CAMERA.height)
    np.testing.assert_allclose([float(n) for n in numbers], [CAMERA.fx, CAMERA.fy, CAMERA.cx + 0.5, CAMERA.cy + 0.5])
    assert len(list((tmp_path / "out" / "images").iterdir())) == FRAMES


def test_another_layout_leaves_no_files_of_the_one_before(walk: Path, tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="needs h5py: pip install 'improvo[hdf5]'")
    pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'improvo[truth]'")
    files = {"hloc": {"features.h5", "matches.h5", "pairs.txt", "intrinsics.txt"}, "colmap": {"database.db"}}
    for layout, frames in (("hloc", 5), ("colmap", 4), ("hloc", 4), ("hloc", 3)):
        export(walk, tmp_path / "out", layout, "--max-frames", str(frames))
        found = {path.name for path in (tmp_path / "out").iterdir() if path.is_file() and path.name[0] != "."}
        assert files[layout] <= found
        assert not found & set.union(*(names for other, names in files.items() if other != layout))
        pictures = {path.name for path in (tmp_path / "out" / "images").iterdir()}
        assert pictures == {f"{number:06d}.png" for number in range(frames)}  # hloc takes all that are there


def test_a_frame_that_is_left_out_is_said(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("h5py", reason="needs h5py: pip install 'improvo[hdf5]'")
    damaged = Path(shutil.copytree(walk, tmp_path / "walk"))
    (damaged / "000002.png").write_bytes(b"\x89PNG broken")
    export(damaged, tmp_path / "out", "hloc", "--max-frames", "4")
    said = capsys.readouterr().out
    assert "3 images" in said
    assert f"without 1 frame that could not be read, first {damaged / '000002.png'}: " in said
    names = [line.split()[0] for line in (tmp_path / "out" / "intrinsics.txt").read_text().splitlines()]
    assert names == ["000000.png", "000001.png", "000003.png"]


def test_bits_are_unit_vectors_with_the_same_neighbours(walk: Path, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="needs h5py: pip install 'improvo[hdf5]'")
    export(walk, tmp_path / "out", "hloc", "--frontend", "orb", "--max-frames", "2", "--no-images")
    with h5py.File(tmp_path / "out" / "features.h5", "r", libver="latest") as file:
        assert file["000000.png"]["descriptors"].dtype == np.float16
        assert set(np.unique(np.abs(file["000000.png"]["descriptors"]))) == {0.0625}  # 256 bits
    assert not (tmp_path / "out" / "images").exists()


def test_colmap_reconstructs_the_true_path(walk: Path, tmp_path: Path, capsys) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'improvo[truth]'")
    folder = tmp_path / "out"
    export(walk, folder, "colmap", "--window", "8")
    verified = int(re.search(r"(\d+) verified pairs", capsys.readouterr().out)[1])
    assert verified >= 3 * FRAMES
    database = pycolmap.Database.open(folder / "database.db")
    features = features_of(load_frontend("sift", 500), open_sequence(walk)[0])
    image = database.read_image_with_name("000000.png")
    np.testing.assert_allclose(database.read_keypoints(image.image_id)[:, :2], features.keypoints + 0.5, atol=1e-4)
    camera = database.read_camera(image.camera_id)
    np.testing.assert_allclose(camera.params, [CAMERA.fx, CAMERA.fy, CAMERA.cx + 0.5, CAMERA.cy + 0.5])
    assert camera.has_prior_focal_length
    database.close()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = 1, 0, 5
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.init_min_tri_angle = 2.0  # the walk is short
    (folder / "sparse").mkdir()
    models = pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder / "sparse", options=options)
    best = max(models.values(), key=lambda model: model.num_reg_images())
    assert best.num_reg_images() >= FRAMES - 2
    assert best.compute_mean_reprojection_error() < 1
    numbers = [int(Path(image.name).stem) for image in best.images.values()]
    centres = np.array([image.projection_center() for image in best.images.values()])
    truth = np.array(list(hand_motion(FRAMES, step=0.025)))[numbers, :3, 3]
    moved = align_points(truth, centres, with_scale=True).apply(centres)
    path = np.linalg.norm(np.diff(truth[np.argsort(numbers)], axis=0), axis=1).sum()
    assert np.sqrt(((moved - truth) ** 2).sum(axis=1).mean()) < 0.02 * path


def test_what_cannot_be_exported_is_one_line(walk: Path, tmp_path: Path, capsys) -> None:
    pytest.importorskip("h5py", reason="needs h5py: pip install 'improvo[hdf5]'")
    out = tmp_path / "out"
    for words, message in (
        (["--window", "0"], "window"),
        (["--frontend", "nobody"], "unknown"),
        (["--start", "400"], "frames"),
    ):
        assert main(["export", "features", str(walk), "--layout", "hloc", "-o", str(out), *words]) == 2
        shown = capsys.readouterr()
        assert message in shown.err
        assert len(shown.err.splitlines()) == 1
        assert not out.exists()
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    assert main(["export", "features", str(walk), "--layout", "hloc", "-o", str(out)]) == 2
    assert [path.name for path in out.iterdir()] == ["mine.txt"]
