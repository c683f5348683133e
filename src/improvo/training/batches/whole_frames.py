"""Frames as they are, with what the teachers say of them: said once for each frame, and remembered."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from improvo.frontend.architecture import CELL
from improvo.training.batches.picture_store import PictureStore
from improvo.types import Int64


class WholeFrames:
    """Frames of a store without any change, but for what is beyond the last whole cell.

    What is said is kept in half precision, so that it is the same whether it was remembered or not.

    Args:
        store: of the pictures.
        taught: what the teachers say of images (V, 1, H, W) uint8, each of it (V, ...).
        most: frames that are remembered; of 640×480 one takes some 2 MB.
    """

    def __init__(self, store: PictureStore, taught: Callable[[Tensor], dict[str, Tensor]], most: int) -> None:
        self._store, self._taught, self._most = store, taught, most
        self._known: OrderedDict[int, dict[str, Tensor]] = OrderedDict()

    def size(self, row: int) -> tuple[int, int]:
        """Width, height of a frame so cut."""
        width, height = (int(side) // CELL * CELL for side in self._store.sizes[row])
        return width, height

    def batch(self, rows: Int64) -> dict[str, Tensor]:
        """`images` (V, 1, H, W) uint8 and what the teachers say of them, of frames (V,) of one size."""
        parts = [self._frame(int(row)) for row in rows]
        said = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        if "stem" in said and said["stem"].dtype == torch.float16:  # which the layers above do not read
            said["stem"] = said["stem"].float()
        return said

    def _frame(self, row: int) -> dict[str, Tensor]:
        if row in self._known:
            self._known.move_to_end(row)
            return self._known[row]
        images = self._store.views(np.array([row]), np.eye(3)[None], *self.size(row)).round().to(torch.uint8)
        said = {name: values.to(torch.float16) if values.dtype == torch.float32 else values
                for name, values in self._taught(images).items()}  # fmt: skip
        self._known[row] = {"images": images, **said}
        if len(self._known) > self._most:
            self._known.popitem(last=False)
        return self._known[row]
