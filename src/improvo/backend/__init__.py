"""Bundle adjustment: the paper's objective and the solver that minimises it. It takes and returns plain arrays.

It imports `geometry`. Open `objective.py` first: the equation, in NumPy. `solver.py` is the fast solver of the same
objective; its compiled kernels load with the first call of `solve`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from improvo.backend.problem import BundleProblem, BundleResult
from improvo.backend.settings import ObjectiveSettings, SolverSettings

if TYPE_CHECKING:
    from improvo.backend.solver import solve

__all__ = ["BundleProblem", "BundleResult", "ObjectiveSettings", "SolverSettings", "solve"]


def __getattr__(name: str) -> Any:
    if name == "solve":
        from improvo.backend.solver import solve

        return solve
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
