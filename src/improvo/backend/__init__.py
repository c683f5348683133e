"""Bundle adjustment: the paper's objective, its solver, and triangulation with the poses held.

Light to import; the compiled kernels load with the first use of `solve` and its like.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from improvo.backend.problem import BundleProblem, BundleResult
from improvo.backend.settings import ObjectiveSettings, SolverSettings, TriangulationSettings

if TYPE_CHECKING:
    from improvo.backend.solver import solve
    from improvo.backend.triangulation import Triangulation, triangulate_tracks

_LAZY = {
    "solve": "improvo.backend.solver",
    "Triangulation": "improvo.backend.triangulation",
    "triangulate_tracks": "improvo.backend.triangulation",
}

__all__ = [
    "BundleProblem",
    "BundleResult",
    "ObjectiveSettings",
    "SolverSettings",
    "Triangulation",
    "TriangulationSettings",
    "solve",
    "triangulate_tracks",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
