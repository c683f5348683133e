"""Small line charts as SVG, sharp on every screen and light in a page."""

from __future__ import annotations

from html import escape

import numpy as np

from improvo.types import Float64

# room for letters of 22 px, which a telephone shows at this width (page.css)
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 900, 206, 72, 52, 28
_SMALLEST = 1e-12  # a largest value that is worth a scale of its own


def line_chart(x: Float64, y: Float64, label: str, across_of: str = "frame") -> str:
    """An SVG of `y` over `x` (NaN leaves a gap; a value alone between two is a dot), from zero to the largest value.

    Args:
        x, y: (N,); x are numbers of frames, steps or rounds, y not below zero.
        label: title of the upright axis, said to screen readers too.
        across_of: title of the other axis.
    """
    known = np.isfinite(y)
    top = max(float(y[known].max()), 0.0) if known.any() else 0.0
    top = top if top > _SMALLEST else 1.0
    step = _nice_step(top)
    left, right = (float(x.min()), float(x.max())) if len(x) else (0.0, 1.0)
    across = (np.asarray(x, np.float64) - left) / max(right - left, 1e-12) * (_WIDTH - _LEFT - 8) + _LEFT
    up = _HEIGHT - _BOTTOM - np.clip(y / top, 0, 1) * (_HEIGHT - _BOTTOM - _TOP)
    parts = []
    for value in np.arange(0, top * (1 + 1e-9), step):
        row = _HEIGHT - _BOTTOM - value / top * (_HEIGHT - _BOTTOM - _TOP)
        parts.append(
            f'<line x1="{_LEFT}" x2="{_WIDTH - 8}" y1="{row:.1f}" y2="{row:.1f}" stroke="currentColor" opacity=".15"/>'
            f'<text x="{_LEFT - 6}" y="{row + 4:.1f}" text-anchor="end">{value:g}</text>'
        )
    # where the whole number stands that is written there
    columns = np.arange(left, right + 1) if right - left < 6 else np.rint(np.linspace(left, right, 6))
    for value in columns:
        column = (value - left) / max(right - left, 1e-12) * (_WIDTH - _LEFT - 8) + _LEFT
        anchor = "end" if value == columns[-1] and len(columns) > 1 else "middle"  # the last one ends with the line
        parts.append(f'<text x="{column:.1f}" y="{_HEIGHT - 30}" text-anchor="{anchor}">{value:.0f}</text>')
    middle = (_WIDTH + _LEFT) / 2
    parts.append(f'<text x="{middle:.0f}" y="{_HEIGHT - 6}" text-anchor="middle">{escape(across_of)}</text>')
    parts.append(f'<text x="2" y="18">{escape(label)}</text>')
    breaks = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    for first, end in zip(breaks[::2], breaks[1::2], strict=True):
        if end - first == 1:
            parts.append(f'<circle cx="{across[first]:.1f}" cy="{up[first]:.1f}" r="2.5" fill="var(--accent)"/>')
            continue
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across[first:end], up[first:end], strict=True))
        parts.append(f'<polyline points="{points}" fill="none" stroke="var(--accent)" stroke-width="1.6"/>')
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(label, quote=True)}" '
        f'font-size="11" fill="currentColor" width="{_WIDTH}">{"".join(parts)}</svg>'
    )


def _nice_step(top: float) -> float:
    """A round distance of grid lines that gives three to five of them."""
    raw = top / 4
    power = 10 ** np.floor(np.log10(raw))
    return float(next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * 0.999))
