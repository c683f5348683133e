"""The one way in which improvo's numeric kernels are compiled.

`fastmath` is left off (it may drop checks for NaN), `parallel` too: one thread, the same bits each time. Division by
zero gives infinity as in NumPy, without the branch that Python's error would need; callers compare such that an
infinite or undefined number fails. The GIL is released. Machine code is cached on disk: a kernel that another one
calls becomes part of it, so after an edit of the callee touch the file of the caller (or delete the cache) as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from numba import njit

_OPTIONS = {"nogil": True, "error_model": "numpy"}


def compiled(function: Callable[..., Any]) -> Any:
    """A kernel: compiled when it is first called."""
    return _jit(function)


def inlined(function: Callable[..., Any]) -> Any:
    """A small part of kernels that becomes part of its callers before they are compiled."""
    return _jit(function, inline="always")


def all_cached(kernels: Iterable[Any]) -> bool:
    """Whether each kernel has machine code on disk; it may still be stale, which only costs a compilation."""
    return all(_is_cached(kernel) for kernel in kernels)


def _is_cached(kernel: Any) -> bool:
    folder = kernel.stats.cache_path  # None where nothing can be cached
    return folder is not None and any(Path(folder).glob(f"*.{kernel.__name__}-*.nbi"))


def _jit(function: Callable[..., Any], **options: Any) -> Any:
    try:
        return njit(cache=True, **_OPTIONS, **options)(function)
    except RuntimeError:  # neither the package's folder nor the user's cache can be written: compile each time
        return njit(**_OPTIONS, **options)(function)
