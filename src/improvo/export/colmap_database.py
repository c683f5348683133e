"""Features and verified matches as COLMAP's database, from which its mapper reconstructs.

Written by pycolmap, so that the tables are those of the COLMAP that reads them. COLMAP puts the centre of the top-left
pixel at (0.5, 0.5); keypoints and principal point move by half a pixel.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from improvo.evaluation.truth.structure_from_motion import colmap_at, load_pycolmap
from improvo.export.features import MatchedFrame
from improvo.export.hloc import Written
from improvo.files import write_text, written_atomically
from improvo.geometry.camera import Camera


def write_colmap_database(frames: Iterable[MatchedFrame], camera: Camera, folder: Path, seed: int) -> Written:
    """Write `database.db`: one camera, the images, their keypoints, matches, and the two-view geometry of each pair.

    Args:
        frames: in order.
        camera: pinhole, of all of them; its focal length counts as known.
        folder: of the file; `pairs.txt` lies beside it.
        seed: of the verification.

    Returns:
        Its matches are those that the two-view geometry keeps, its pairs those that have one.

    Raises:
        MissingExtraError: without pycolmap.
        OutputError: a file cannot be written.
    """
    pycolmap = load_pycolmap()
    pairs: list[str] = []
    keypoints = 0
    ids: dict[str, int] = {}
    with _database_file(folder / "database.db") as temporary:
        database = pycolmap.Database.open(str(temporary))
        try:
            own = pycolmap.Camera(
                model="PINHOLE",
                width=camera.width,
                height=camera.height,
                params=[camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5],
            )
            own.has_prior_focal_length = True
            own.camera_id = database.write_camera(own)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(own.sensor_id)
            rig.rig_id = database.write_rig(rig)
            for frame in frames:
                number = _write_image(pycolmap, database, frame.name, own, rig)
                ids[frame.name] = number
                database.write_keypoints(number, frame.features.keypoints.astype(np.float32) + 0.5)
                for earlier, found in frame.matches:
                    database.write_matches(ids[earlier], number, found.astype(np.uint32))
                    pairs.append(f"{earlier} {frame.name}\n")
                keypoints += len(frame.features)
        finally:
            database.close()
        write_text(folder / "pairs.txt", "".join(pairs))
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = seed
        if pairs:
            pycolmap.verify_matches(str(temporary), str(folder / "pairs.txt"), options=options)
        database = pycolmap.Database.open(str(temporary))
        try:
            verified, inliers = int(database.num_verified_image_pairs()), int(database.num_inlier_matches())
        finally:
            database.close()
    return Written(len(ids), keypoints, verified, inliers)


@contextmanager
def _database_file(path: Path) -> Iterator[Path]:
    """A temporary path that becomes `path`; SQLite's own files beside it go with it.

    Raises:
        OutputError: it cannot be written.
    """
    with written_atomically(path) as temporary:
        try:
            with colmap_at(path):
                yield temporary
        finally:
            for ending in ("-wal", "-shm", "-journal"):
                temporary.with_name(temporary.name + ending).unlink(missing_ok=True)


def _write_image(pycolmap: Any, database: Any, name: str, camera: Any, rig: Any) -> int:
    """A row for the image, and for the frame of a rig that it is in COLMAP 4; the image's number."""
    image = pycolmap.Image(name=name, camera_id=camera.camera_id)
    image.image_id = database.write_image(image)
    frame = pycolmap.Frame()
    frame.rig_id = rig.rig_id
    frame.add_data_id(image.data_id)
    database.write_frame(frame)
    return int(image.image_id)
