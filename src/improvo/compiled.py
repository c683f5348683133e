"""The one way in which improvo's numeric kernels are compiled.

`fastmath` is left off (it may drop checks for NaN), `parallel` too: one thread, the same bits each time. Division by
zero gives infinity as in NumPy, without the branch that Python's error would need; callers compare such that an
infinite or undefined number fails. The GIL is released. Machine code is cached on disk: a kernel that another one
calls becomes part of it, so after an edit of the callee touch the file of the caller (or delete the cache) as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
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
        kernel = njit(cache=True, **_OPTIONS, **options)(function)
    except RuntimeError:  # neither the package's folder nor the user's cache can be written: compile each time
        return njit(**_OPTIONS, **options)(function)
    _never_depend_on_disk(kernel)
    return kernel


def _never_depend_on_disk(kernel: Any) -> None:
    """Machine code that cannot be kept, or is damaged, costs a compilation and nothing else.

    The disk of the cache may be full while there is space for the output, and a power cut may leave a file empty.
    """
    cache = kernel._cache
    load, save = cache.load_overload, cache.save_overload

    def loaded(*what: Any) -> Any:
        try:
            return load(*what)
        except Exception:  # of unpickling and of the linker, many kinds
            with suppress(Exception):
                cache.flush()
            return None

    def saved(*what: Any) -> None:
        with suppress(Exception):
            save(*what)

    cache.load_overload, cache.save_overload = loaded, saved
