"""What a round will take, said before it begins: minutes, memory and disk, from the amount of video."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from improvo.errors import OutputError
from improvo.improvement.recipe import stages, steps_of
from improvo.improvement.settings import HELD, METRIC, ImproveSettings
from improvo.terminal import counted

# seconds on two calm cores with `superpoint-small`; `superpoint` takes about four times as long where it trains
_SECONDS_PER_FRAME = 0.12  # of odometry, at 640x480
_SECONDS_PER_DEPTH = 0.35
_SECONDS_PER_STEP = 0.2  # one core of an AMD EPYC with AVX-512 BF16, 2026-11-28; in float32 two to three times as long
_MIB_PER_REMEMBERED = 2.1  # frame of 640x480, with what is held to
_SECONDS_PER_PAIR = 0.08
_GAPS = 3  # between the frames of a pair
_SECONDS_PER_FRAME_PAIR = 0.02  # of the stage `metric`, beside the features of its frames
_LARGER = 4.0  # times as long for a step of the full network
_MIB = 2**20
_TORCH_MIB = 900  # of a process that trains


@dataclass(frozen=True)
class Costs:
    """Seconds of the parts of the loop."""

    frame: float  # of odometry
    depth: float  # of a depth map
    step: float  # of training
    pair: float  # that a candidate is measured on
    start: float = 0.0  # of a training, before its first step

    @classmethod
    def usual(cls, pixels: int, parameters: int) -> Costs:
        """On two calm cores, by the pixels of a frame and the parameters of the network."""
        size = pixels / (640 * 480)
        step = _SECONDS_PER_STEP * (_LARGER if parameters > 1_000_000 else 1.0)
        return cls(_SECONDS_PER_FRAME * size, _SECONDS_PER_DEPTH * size, step, _SECONDS_PER_PAIR)


@dataclass(frozen=True)
class Estimate:
    """Roughly what is needed; with the usual costs, within a factor of two."""

    minutes: float
    memory_mib: float
    disk_mib: float
    steps: int
    labeled_frames: int  # over all rounds
    other_minutes: float  # of depth, training and validation

    @property
    def words(self) -> str:
        """For a person."""
        minutes = max(self.minutes, 1)
        time = counted(round(minutes), "minute") if minutes < 100 else f"{minutes / 60:.1f} hours"
        return (
            f"about {time} on two calm cores, {self.memory_mib / 1024:.1f} GiB of memory "
            f"and {_size(self.disk_mib)} of disk; {self.steps} steps of training a round"
        )


def _size(mib: float) -> str:
    return f"{mib:.0f} MiB" if mib < 1000 else f"{mib / 1024:.1f} GiB"


def estimate(
    settings: ImproveSettings,
    rounds: int,
    training: int,
    held_back: int,
    pixels: int,
    costs: Costs,
    recordings: int = 0,
) -> Estimate:
    """Estimate all of the loop.

    Args:
        settings: of the loop.
        rounds: to come; a control has as many.
        training, held_back: frames of the two parts.
        pixels: of a frame.
        costs: of its parts.
        recordings: that are held back as a whole; 0 where a part of the only one is.
    """
    reference = settings.reference
    deep = min(training, reference.most_training) + min(held_back, reference.most_held_back)
    steps = steps_of(settings, training)
    trainings, judged = rounds * (1 + settings.control), rounds + settings.control
    each, planned = 0.0, stages(settings)
    if planned != (METRIC,):
        each += costs.start + (60 * settings.minutes if settings.minutes else steps * costs.step)
    if METRIC in planned:
        each += min(training, reference.most_training) * costs.frame + settings.metric.pairs * _SECONDS_PER_FRAME_PAIR
    labeled = training if settings.teaches_labels else 0
    # of a whole recording the reference run, which every recipe makes, has the labels of the start already
    again = 0 if recordings else labeled + held_back
    frames = training + held_back + again + (rounds - 1) * labeled + judged * held_back
    pairs = max(recordings, 1) * min(settings.validation.matches.pairs, held_back // max(recordings, 1))
    validations = (1 + judged) * pairs * _GAPS * costs.pair
    others = deep * costs.depth + trainings * each + validations
    small = min(pixels, settings.held.longer_side**2 * 3 // 4)
    taught = min(training, reference.most_training)
    memory = _TORCH_MIB + taught * (2.5 * small + 4 * pixels / 4) / _MIB
    if settings.recipe == HELD and settings.held.pairs.whole_frames:
        remembered = min(taught, settings.held.pairs.frames_remembered)
        memory += remembered * _MIB_PER_REMEMBERED * small / (640 * 480)
    labels = 0.1 * (training + held_back + rounds * labeled + (1 + judged) * held_back)
    disk = 60 + labels + deep * pixels / 4 * 1.3 / _MIB + 12 * trainings
    return Estimate((frames * costs.frame + others) / 60, memory, disk, steps, frames, others / 60)


def refuse_full_disk(folder: Path, needed: Estimate) -> None:
    """Say that the disk is too full before hours of work, not after.

    Raises:
        OutputError: less is free than a third of what is estimated.
    """
    free = shutil.disk_usage(_existing(folder)).free / _MIB
    if free < needed.disk_mib / 3:
        raise OutputError(
            f"{folder}: {free:.0f} MiB are free where about {needed.disk_mib:.0f} MiB are needed; make room, or choose "
            "a folder on another disk"
        )


def _existing(folder: Path) -> Path:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return Path(os.path.realpath(folder))
