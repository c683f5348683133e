"""Camera calibrations, from every notation people have them in (docs/cameras.md lists them).

Keys that could be distortion, a lens model or an image size are read or refused, never dropped: a calibration that is
read almost gives a trajectory that is many times worse, and nobody knows why.
"""

from improvo.geometry.camera_files.calibration import (
    Calibration,
    calibration_yaml,
    check_field_of_view,
    from_field_of_view,
)
from improvo.geometry.camera_files.colmap import colmap_calibration
from improvo.geometry.camera_files.containers import parse_yaml
from improvo.geometry.camera_files.loading import camera_of, folder_calibration, load_calibration

__all__ = [
    "Calibration",
    "calibration_yaml",
    "camera_of",
    "check_field_of_view",
    "colmap_calibration",
    "folder_calibration",
    "from_field_of_view",
    "load_calibration",
    "parse_yaml",
]
