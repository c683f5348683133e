"""The training loop of every stage: seeded, resumable to the bit, with metrics and checkpoints.

Batch number i is a function of the seed and i alone, and a step of the batch and the weights alone. So a run that was
killed and continues from its checkpoint ends with the weights of one that was not.
"""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections import deque
from collections.abc import Iterator
from contextlib import AbstractContextManager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from improvo import files, terminal
from improvo.errors import ImprovoError, InputError, first_line
from improvo.formats import FORMAT, FORMAT_KEY, check_format
from improvo.training.device import choose_device, choose_precision
from improvo.training.distributed import Process
from improvo.training.metrics import METRICS, append_metrics, keep_metrics
from improvo.training.settings import OptimiserSettings
from improvo.training.shared_statistics import share_batch_norm
from improvo.training.stages.base import Stage

CHECKPOINT = "checkpoint.pt"


class Batches(Protocol):
    """Batches by number, made by any process."""

    def __len__(self) -> int: ...

    def __getitem__(self, step: int) -> dict[str, Any]: ...


class DivergedError(ImprovoError):
    """The loss is no longer a number."""


class Trainer:
    """Runs one stage.

    The folder must be this process's alone (`improvo.folder_lock`).

    Args:
        stage: network and losses.
        batches: the data, by step.
        settings: see `OptimiserSettings`.
        folder: gets `checkpoint.pt` and `metrics.jsonl`.
        seconds: of training, over all runs; where given, the number of steps follows from it and from how long a step
            takes, until the learning rate begins to fall. Needs batches without workers.
    """

    def __init__(
        self, stage: Stage, batches: Batches, settings: OptimiserSettings, folder: Path, seconds: float = 0.0
    ) -> None:
        if settings.threads:
            torch.set_num_threads(settings.threads)
        self.device = choose_device(settings.device)
        self.precision = choose_precision(settings.precision, self.device)
        self.stage = stage.to(self.device, memory_format=torch.channels_last)
        share_batch_norm(self.stage)
        self.average = deepcopy(self.stage).requires_grad_(False)
        self.batches, self.settings, self.folder, self.allowed = batches, settings, folder, seconds
        trained = self.stage.state_dict()
        self._averaged = [
            (value, trained[name]) for name, value in self.average.state_dict().items() if value.is_floating_point()
        ]
        decayed = [p for p in stage.parameters() if p.ndim > 1]
        others = [p for p in stage.parameters() if p.ndim <= 1]
        self.optimiser = torch.optim.AdamW(
            [{"params": decayed, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}],
            lr=settings.learning_rate,
            fused=True,
        )
        self.process = Process.current()
        self.process.join(self.device.type)
        self.step = 0
        self.seconds = 0.0  # of training, over all runs
        self._warm = False
        self._recent: deque[float] = deque(maxlen=9)  # seconds of a step, in the last rows of metrics

    def resume(self) -> bool:
        """Continue from the folder's checkpoint, if there is one; rows of metrics behind it are dropped.

        Raises:
            InputError: the checkpoint is not readable or of another network.
        """
        path = self.folder / CHECKPOINT
        if not path.is_file():
            if self.process.leads:
                keep_metrics(self.folder / METRICS, 0)
            return False
        try:
            state = torch.load(path, map_location=self.device, weights_only=True)
            check_format(state.get(FORMAT_KEY), path, "choose a new output folder")
            self.stage.load_state_dict(state["stage"])
            self.average.load_state_dict(state["average"])
            self.optimiser.load_state_dict(state["optimiser"])
            self.step, self.seconds = int(state["step"]), float(state["seconds"])
            if self.allowed:
                self.settings = replace(self.settings, **state["planned"])
        except ImprovoError:
            raise
        except Exception as error:  # torch raises many kinds; none of them is worth a traceback
            raise InputError(
                f"{path}: cannot be continued from ({first_line(error)}); choose a new output folder"
            ) from None
        if self.process.leads:
            keep_metrics(self.folder / METRICS, self.step)
        return True

    def save(self) -> None:
        """Write the checkpoint atomically."""
        state = {
            FORMAT_KEY: FORMAT,
            "stage": self.stage.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "planned": {"steps": self.settings.steps, "decay_steps": self.settings.decay_steps},
        }
        with files.written_atomically(self.folder / CHECKPOINT) as temporary:
            try:
                torch.save(state, temporary)
            except RuntimeError as error:  # what torch makes of a full disk
                raise OSError(f"is the disk full? {first_line(error)}") from None

    def run(self, progress: bool = True, on_checkpoint: Any = None) -> nn.Module:
        """Train up to the last step; returns the averaged network.

        Args:
            on_checkpoint: called with this trainer after every checkpoint.

        Raises:
            DivergedError: the loss is NaN or infinite; the last checkpoint stays.
        """
        self.stage.train()
        sums: dict[str, Tensor] = {}
        window_start = saved = time.monotonic()
        count, waiting = 0, 0.0
        loader = iter(self._loader())
        total = None if self.allowed else self.settings.steps
        with terminal.progress("training", "step", total, progress and self.process.leads, self.step) as shown:
            while self.step < self.settings.steps:
                before = time.monotonic()
                batch = next(loader)
                waiting += time.monotonic() - before
                for name, value in self._step(batch).items():
                    sums[name] = sums[name] + value if name in sums else value
                self.step += 1
                count += 1
                shown.advance()
                if self.step % self.settings.log_every and self.step < self.settings.steps:
                    continue
                row = {name: float(value) / count for name, value in sums.items()}
                now = time.monotonic()
                self._stop_if_diverged(row["loss"])
                self.seconds += now - window_start
                self._log(row, (now - window_start) / count, waiting / (now - window_start))
                self._plan((now - window_start) / count)
                sums, count, waiting, window_start = {}, 0, 0.0, now
                last = self.step == self.settings.steps
                if self.process.leads and (now - saved > 60 * self.settings.checkpoint_minutes or last):
                    self.save()
                    saved = now
                    if on_checkpoint:
                        on_checkpoint(self)
        self.process.wait_for_all()  # nobody goes on before the files are written
        network: nn.Module = self.average.network
        return network.eval()

    def _plan(self, step_seconds: float) -> None:
        """Choose the number of steps anew from the time that is left; a fall of the rate that has begun is kept."""
        if not self._warm:  # the first steps take as long as the device needs to get ready
            self._warm = True
            return
        self._recent.append(step_seconds)
        if not self.allowed or self.step > self.settings.steps - self._decay_steps:
            return
        usual = statistics.median(self._recent)
        remaining = max(round((self.allowed - self.seconds) / usual), 1)
        steps = self.step + max(remaining, self.step // 2)  # not into a fall that should have begun
        self.settings = replace(self.settings, steps=steps, decay_steps=steps)

    @property
    def _decay_steps(self) -> int:
        return max(min(self.settings.decay_steps, self.settings.steps // 3), 1)

    def _step(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        settings = self.settings
        batch = {name: value.to(self.device, non_blocking=True) for name, value in batch.items()}
        if "images" in batch:
            images = batch["images"].float() / 255
            batch["images"] = images.contiguous(memory_format=torch.channels_last)
        for group in self.optimiser.param_groups:
            group["lr"] = settings.learning_rate * self._rate(self.step)
        with self._autocast():
            losses = self.stage.losses(batch)
        self.optimiser.zero_grad(set_to_none=True)
        losses["loss"].backward()
        self.process.average_gradients(self.stage.parameters())
        nn.utils.clip_grad_norm_(self.stage.parameters(), settings.clip_norm)
        self.optimiser.step()
        self._follow()
        return {name: value.detach() for name, value in losses.items()}

    def _rate(self, step: int) -> float:
        """Share of the learning rate: linear warm-up, constant, linear fall to zero over the last steps."""
        settings = self.settings
        rising = (step + 1) / max(settings.warmup_steps, 1)
        falling = (settings.steps - step) / self._decay_steps
        return min(1.0, rising, falling)

    def _follow(self) -> None:
        """Exponential moving average of weights and batch-norm statistics; young averages follow faster."""
        decay = min(self.settings.ema, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_([kept for kept, _ in self._averaged], [now for _, now in self._averaged], 1 - decay)

    def _autocast(self) -> AbstractContextManager[None]:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == torch.bfloat16)

    def _loader(self) -> Iterator[dict[str, Tensor]]:
        workers = self.settings.workers
        if self.allowed:
            return (self.batches[step] for step in itertools.count(self.step))
        return DataLoader(
            self.batches,
            batch_size=None,
            sampler=range(self.step, self.settings.steps),
            num_workers=workers,
            prefetch_factor=4 if workers else None,
            pin_memory=self.device.type == "cuda" and workers > 0,
        )

    def _stop_if_diverged(self, loss: float) -> None:
        if not math.isfinite(loss):
            raise DivergedError(
                f"{self.folder}: the loss is {loss} at step {self.step}; the last checkpoint is kept: lower "
                "learning_rate or clip_norm, or use precision=float32, and start again"
            )

    def _log(self, losses: dict[str, float], step_seconds: float, loading: float) -> None:
        if not self.process.leads:
            return
        row = {
            "step": self.step,
            **{name: round(value, 6) for name, value in losses.items()},
            "learning_rate": self.settings.learning_rate * self._rate(self.step - 1),
            "step_seconds": round(step_seconds, 4),
            "loading_share": round(loading, 4),
        }
        append_metrics(self.folder / METRICS, row)
