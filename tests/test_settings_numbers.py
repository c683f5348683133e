"""Every number in every dataclass of settings, by a test that finds them: what makes no sense is refused."""

from __future__ import annotations

import dataclasses
import math
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rendered_walk import write_walk

import improvo
from improvo import config
from improvo.backend.settings import SolverSettings
from improvo.cli.commands import settings_class
from improvo.cli.config import SETTINGS
from improvo.cli.flags import comments
from improvo.errors import ConfigError, InputError
from improvo.frontend.settings import NetworkSettings
from improvo.geometry.settings import TriangulationSettings
from improvo.report.track_pictures import TrackPictureSettings
from improvo.sequences import SequenceSettings, open_sequence

_INNER = (SolverSettings, NetworkSettings, TriangulationSettings, TrackPictureSettings)  # that no command shows
_CORRELATIONS = {("SweepSettings", "min_score"), ("RefineSettings", "min_score")}  # from -1
# Of these the comment says `share`, too: lengths in units of another one, a ratio of two counts, words on the result.
_NO_SHARES = {
    *(("NeighbourSettings", "max_baseline"), ("CloudSettings", "voxel"), ("AgreementSettings", "max_contradicting")),
    *(("MatchingSettings", "max_distance"), ("PoseSettings", "right_px"), ("SolverSettings", "initial_damping")),
}
_ZERO_IS_NOTHING = [("MatchingSettings", "max_distance"), ("SelfCalibrationSettings", "max_rate")]
_ZERO_IS_NOTHING += [("SelfCalibrationSettings", "max_rms"), ("ValidationSettings", "calibration_images")]


def _settings_classes() -> dict[str, type]:
    found: dict[str, type] = {}

    def add(cls: type) -> None:
        found[cls.__name__] = cls
        for base in cls.__mro__[1:]:
            if dataclasses.is_dataclass(base):
                found[base.__name__] = base
        for kind in typing.get_type_hints(cls).values():
            if dataclasses.is_dataclass(kind) and typing.cast(type, kind).__name__ != "Palette":
                add(typing.cast(type, kind))

    for name in SETTINGS.values():
        add(settings_class(name))
    for cls in _INNER:
        add(cls)
    return found


CLASSES = _settings_classes()


def _numbers() -> Iterator[tuple[type, str, Any, bool]]:
    """Class, field, default, and whether it is a float, of every number or tuple of numbers."""
    for cls in CLASSES.values():
        plain = cls()
        for field in dataclasses.fields(cls):
            hint = str(typing.get_type_hints(cls)[field.name])
            kinds = set(re.findall(r"\b(int|float|bool|str)\b", hint))
            if kinds & {"int", "float"} and not kinds & {"bool", "str"}:
                yield cls, field.name, getattr(plain, field.name), "float" in kinds


NUMBERS = [pytest.param(*each, id=f"{each[0].__name__}.{each[1]}") for each in _numbers()]
FLOATS = [each for each in NUMBERS if each.values[3]]


def _said(cls: Any, name: Any) -> str:
    return f"{name} {comments(cls).get(name, '')}"


def _with(cls: type, name: str, default: Any, value: float) -> Any:
    """Settings in which one number is this one; of several, all of them."""
    if name == "distances":  # of the scale
        return dataclasses.replace(cls(), source="distance", distances=((0, 1, value),))
    if name == "metres":
        return dataclasses.replace(cls(), source="height", metres=value)
    return dataclasses.replace(cls(), **{name: (value,) * max(len(default), 1) if type(default) is tuple else value})


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("numbers") / "walk", frames=4)


def test_all_settings_are_looked_at() -> None:
    source = Path(improvo.__file__).parent
    words = "".join(path.read_text(encoding="utf-8") for path in sorted(source.rglob("*.py")))
    written = set(re.findall(r"^@dataclass.*\nclass (\w+(?:Settings|Options))\b", words, re.MULTILINE))
    assert written - CLASSES.keys() == set()
    assert len(NUMBERS) > 250


@pytest.mark.parametrize(("cls", "name", "default", "is_float"), NUMBERS)
def test_what_is_negative_or_no_number_is_refused(
    cls: type, name: str, default: Any, is_float: bool, walk: Path
) -> None:
    wrong = [-1.0, math.nan, -math.inf] if is_float else [-1]
    for value in wrong[1:] if (cls.__name__, name) in _CORRELATIONS else wrong:
        if cls is SequenceSettings:  # is judged together with the recording
            with pytest.raises(InputError, match=name if name != "undistorted_fov" else "fov"):
                open_sequence(walk, _with(cls, name, default, value))
        else:
            with pytest.raises(ConfigError):
                _with(cls, name, default, value)


@pytest.mark.parametrize(("cls", "name", "default", "is_float"), FLOATS)
def test_what_has_no_end_is_refused_in_a_file(cls: type, name: str, default: Any, is_float: bool) -> None:
    """In Python, a limit may be infinite: there is none."""
    if name in ("distances", "metres"):
        text = {"source": "distance", "distances": [[0, 1, ".inf"]]} if name == "distances" else {"metres": ".inf"}
    else:
        text = {name: [".inf"] * max(len(default), 1) if type(default) is tuple else ".inf"}
    values = {key: str(value).replace("'", "") for key, value in text.items()}
    with pytest.raises(ConfigError):
        config.load(cls, None, [f"{key}={value}" for key, value in values.items()])


@pytest.mark.parametrize(
    ("cls", "name", "default", "is_float"),
    [each for each in FLOATS if re.search(r"(\b|_)shares?\b", _said(each.values[0], each.values[1]))],
)
def test_a_share_is_no_more_than_the_whole(cls: type, name: str, default: Any, is_float: bool) -> None:
    if (cls.__name__, name) in _NO_SHARES:
        _with(cls, name, default, 1.5)
    else:
        with pytest.raises(ConfigError):
            _with(cls, name, default, 1.5)


@pytest.mark.parametrize(("cls", "name"), _ZERO_IS_NOTHING)
def test_a_limit_of_nothing_is_refused(cls: str, name: str) -> None:
    with pytest.raises(ConfigError, match=name):
        _with(CLASSES[cls], name, 1, 0)
