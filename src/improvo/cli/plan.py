"""What a plan says: core-hours, memory, disk, and time by the number of workers."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from improvo.cli.output import figures, say
from improvo.terminal import counted

if TYPE_CHECKING:
    from improvo.improvement.plan import ImprovePlan
    from improvo.labeling.plan import LabelPlan

_WORKERS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)


def label_figures(plan: LabelPlan, times: float = 1.0) -> dict[str, Any]:
    """As JSON has them.

    Args:
        plan: of labelling all recordings once.
        times: how often all of them are labelled.
    """
    return {
        **asdict(plan),
        "frames_per_second_per_core": round(1 / plan.frame_seconds, 2),
        "core_hours": round(times * plan.core_seconds / 3600, 4),
        "storage_mib": round(times * plan.storage_mib, 1),
        "seconds_by_workers": {str(n): round(times * plan.seconds(n), 1) for n in useful_workers(plan)},
    }


def useful_workers(plan: LabelPlan) -> list[int]:
    """Powers of two up to one worker for each recording."""
    return [n for n in _WORKERS if n == 1 or n < 2 * plan.recordings]


def say_label_plan(plan: LabelPlan) -> None:
    """For people."""
    values = label_figures(plan)
    say(
        f"sample: {plan.sample_frames} frames on this machine: {values['frames_per_second_per_core']:.3g} frames a "
        f"second per core, {plan.recording_seconds:.2g} core-seconds more for each recording"
    )
    recordings = f"{plan.recordings} recording{'s' * (plan.recordings != 1)}"
    say(f"all: {recordings}, {plan.frames} frames: {duration(plan.core_seconds)} of one core")
    memory = f"{plan.memory_mib} MiB of memory for each worker, " if plan.memory_mib else ""
    say(f"needs {memory}{size(plan.storage_mib)} of disk for the labels")
    times = ", ".join(f"{n}: {duration(plan.seconds(n))}" for n in useful_workers(plan))
    say(f"time by the number of workers, each with a free core: {times}")
    figures(values, "")


def say_improve_plan(plan: ImprovePlan, asked: bool) -> None:
    """For people.

    Args:
        plan: of the loop.
        asked: whether the number of rounds was given; by itself the loop may end before.
    """
    once, needed = plan.once, plan.needed
    values = label_figures(once, plan.labelings)
    say(
        f"sample: {once.sample_frames} frames on this machine: {values['frames_per_second_per_core']:.3g} frames a "
        f"second per core"
    )
    rounds = counted(plan.rounds, "round") if asked else f"up to {counted(plan.rounds, 'round')}"
    say(
        f"labelling: {once.frames} frames, {plan.labelings:.2g} times in {rounds}: "
        f"{duration(plan.labelings * once.core_seconds)} of one core"
    )
    times = ", ".join(f"{n}: {duration(plan.labelings * once.seconds(n))}" for n in useful_workers(once))
    say(f"its time by the number of workers, each with a free core: {times}")
    minutes, where = duration(60 * needed.other_minutes), "of one core"
    if not plan.measured:
        where = "on two calm cores (not measured here, within a factor of two)"
    say(
        f"depth, training and validation: about {minutes} {where}, {size(needed.memory_mib)} of memory; "
        f"{size(needed.disk_mib)} of disk in all"
    )
    figures(
        {"labelling": values, "labelings": plan.labelings, "others": {**asdict(needed), "measured": plan.measured}}, ""
    )


def duration(seconds: float) -> str:
    """Seconds, minutes or hours, whatever reads best."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def size(mib: float) -> str:
    """MiB, GiB or TiB."""
    if mib < 1000:
        return f"{mib:.0f} MiB"
    return f"{mib / 1024:.1f} GiB" if mib < 1e6 else f"{mib / 1024**2:.1f} TiB"
