"""The one way in which sivo's numeric kernels are compiled.

`fastmath` is left off (it may drop checks for NaN), `parallel` too: one thread, the same bits each time. Division by
zero gives infinity as in NumPy, without the branch that Python's error would need; callers compare such that an
infinite or undefined number fails. The GIL is released. Machine code is cached on disk: a kernel that another one
calls becomes part of it, so after an edit of the callee touch the file of the caller (or delete the cache) as well.
"""

from __future__ import annotations

from numba import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")
inlined = njit(cache=True, nogil=True, error_model="numpy", inline="always")
