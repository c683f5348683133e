"""Settings of the search for a camera in a video, importable without heavy modules."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.config import check_seed
from improvo.errors import ConfigError
from improvo.frontend.settings import FrontendSettings
from improvo.odometry.settings import OdometrySettings
from improvo.sequences.base import SequenceSettings


@dataclass(frozen=True)
class SelfCalibrationSettings:
    """`improvo calibrate VIDEO --from motion`, and `--camera auto`."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    frontend: FrontendSettings = field(default_factory=lambda: FrontendSettings(name="sift"))
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    model: str = "auto"  # of the distortion: brown, fisheye, or the one that explains the video clearly better
    frames: int = 400  # looked at; of a longer video, pieces spread over it
    pieces: int = 2
    max_rate: float = 15.0  # frames a second that are enough; of a recording twice as fast every second is looked at
    max_width: int = 1280  # pixels in which keypoints are detected
    pairs: int = 16  # of frames, for the first guess
    views: int = 140  # adjusted together with the camera
    rounds: int = 3  # of odometry and adjustment, at most
    max_focal_deviation: float = 0.01  # of the focal length; a camera that is less sure is refused
    max_rms: float = 1.5  # pixels; a worse fit is refused
    seed: int = 0  # of every RANSAC

    def __post_init__(self) -> None:
        if self.model not in ("auto", "brown", "fisheye"):
            raise ConfigError(f"model {self.model!r}: choose auto, brown or fisheye")
        least = {"frames": 20, "pieces": 1, "max_width": 160, "pairs": 1, "views": 5, "rounds": 1}
        for name, minimum in least.items():
            if getattr(self, name) < minimum:
                raise ConfigError(f"setting `{name}`: must be at least {minimum}, not {getattr(self, name)}")
        if not 0 < self.max_focal_deviation < 1:
            raise ConfigError(f"max_focal_deviation={self.max_focal_deviation}: is a share between 0 and 1")
        for name in ("max_rate", "max_rms"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"setting `{name}`: must be above 0, not {getattr(self, name)}")
        check_seed(self.seed)
