"""Two small plots as inline SVG, drawn with text and lines only: same numbers, same bytes; nothing is loaded."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

WIDTH = 440
INK, MUTED, GRID, LIMIT = "#1d2733", "#5b6774", "#dfe4e9", "#b3261e"
COLOURS = ("#1f6f8b", "#d1603d", "#8a5fbf", "#2c8c4a", "#b8860b")
DASHES = ("", "7 3", "2 3", "10 3 2 3", "5 5")
"""Lines differ in dash and colour: the page may be printed in grey."""


@dataclass(frozen=True)
class Dot:
    """One row of a dot plot; a marked one is drawn filled."""

    label: str
    value: float
    marked: bool


@dataclass(frozen=True)
class Line:
    """One line of a line plot: (x, y) points in order of x."""

    label: str
    points: tuple[tuple[float, float], ...]


def dot_plot(dots: Sequence[Dot], axis: str, limit: float | None = None) -> str:
    """Values on a logarithmic axis, one row each; a value of 0 lies on the left edge. Empty without rows."""
    if not dots:
        return ""
    left, right, row, top = 150, 14, 22, 10
    bottom = top + row * len(dots)
    positive = [v for v in [*(dot.value for dot in dots), limit or 0.0] if v > 0] or [1.0]
    low, high = math.floor(math.log10(min(positive))), math.ceil(math.log10(max(positive)))
    high = max(high, low + 1)

    def x_of(value: float) -> float:
        place = 0.0 if value <= 0 else (math.log10(value) - low) / (high - low)
        return left + place * (WIDTH - left - right)

    parts = []
    for power in range(low, high + 1, max(1, (high - low) // 4)):
        x = x_of(10.0**power)
        parts.append(_line(x, top, x, bottom, GRID))
        parts.append(_text(x, bottom + 15, _decade(power), MUTED, "middle"))
    if limit is not None and limit > 0:
        parts.append(_line(x_of(limit), top, x_of(limit), bottom, LIMIT, "5 3"))
    for index, dot in enumerate(dots):
        y = top + row * (index + 0.5)
        parts.append(_line(left, y, x_of(dot.value), y, GRID))
        parts.append(
            f'<circle cx="{x_of(dot.value):.1f}" cy="{y:.1f}" r="5" stroke="{COLOURS[0]}" stroke-width="2" '
            f'fill="{COLOURS[0] if dot.marked else "#ffffff"}"/>'
        )
        parts.append(_text(left - 8, y + 4, dot.label, INK, "end"))
    parts.append(_text((left + WIDTH - right) / 2, bottom + 34, axis, INK, "middle"))
    return _svg(bottom + 42, f"{axis}: {len(dots)} rows", parts)


def line_plot(lines: Sequence[Line], x_axis: str, y_axis: str, limit: float | None = None) -> str:
    """Lines from zero up, with their names above the plot; empty without points.

    A limit far above all lines is only named: drawn to scale it would press them onto the axis.
    """
    points = [point for line in lines for point in line.points]
    if not points:
        return ""
    left, right, height = 46, 16, 190
    top = 24 + 17 * len(lines)
    bottom = top + height
    x_high = max(max(x for x, _ in points), 1e-9)
    largest = max(y for _, y in points)
    near = limit is not None and largest > 0 and limit <= 2 * largest
    y_high = _round_up(max(largest, limit if near and limit else 0.0) or 1.0)

    def at(x: float, y: float) -> tuple[float, float]:
        return left + x / x_high * (WIDTH - left - right), bottom - min(y / y_high, 1.0) * height

    parts = []
    for step in range(5):
        value = y_high * step / 4
        y = at(0, value)[1]
        parts.append(_line(left, y, WIDTH - right, y, GRID))
        parts.append(_text(left - 6, y + 4, f"{value:g}", MUTED, "end"))
    for x_value in sorted({x for x, _ in points}):
        parts.append(_text(at(x_value, 0)[0], bottom + 15, f"{x_value:g}", MUTED, "middle"))
    if limit is not None:
        y = at(0, limit)[1] if near else top
        beyond = "" if near else ", off the scale"
        parts += [_line(left, y, WIDTH - right, y, LIMIT, "5 3")] if near else []
        parts.append(_text(WIDTH - right, y - 4, f"gate: {limit:g}{beyond}", LIMIT, "end"))
    for index, line in enumerate(lines):
        colour, dash = COLOURS[index % len(COLOURS)], DASHES[index % len(DASHES)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (at(*point) for point in line.points))
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2.2"{dashes}/>')
        y = 14 + 17 * index
        parts.append(_line(left, y - 4, left + 26, y - 4, colour, dash, 2.2))
        parts.append(_text(left + 32, y, line.label, INK, "start"))
    parts.append(_text(left - 36, top - 8, y_axis, INK, "start"))
    parts.append(_text((left + WIDTH - right) / 2, bottom + 34, x_axis, INK, "middle"))
    return _svg(bottom + 42, f"{y_axis} over {x_axis}", parts)


def _svg(height: float, title: str, parts: Sequence[str]) -> str:
    return (
        f'<svg viewBox="0 0 {WIDTH} {height:.0f}" width="100%" role="img" font-family="system-ui, sans-serif" '
        f'font-size="12"><title>{html.escape(title)}</title>{"".join(parts)}</svg>'
    )


def _line(x1: float, y1: float, x2: float, y2: float, colour: str, dash: str = "", width: float = 1.0) -> str:
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}" stroke-width="{width}"'
        f"{dashes}/>"
    )


def _text(x: float, y: float, text: str, colour: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" text-anchor="{anchor}">{html.escape(text)}</text>'


def _decade(power: int) -> str:
    return f"{10.0**power:g}" if -3 <= power <= 3 else f"1e{power}"


def _round_up(value: float) -> float:
    """The next of 1, 2, 4, 5, 8, 10 times a power of ten: four steps of it are round numbers."""
    scale = 10.0 ** math.floor(math.log10(value))
    return next(step * scale for step in (1.0, 2.0, 4.0, 5.0, 8.0, 10.0) if value <= step * scale * (1 + 1e-9))
