"""Floor plans: rectangles that tile a building, openings between them, and the resulting walls."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

Vec2 = tuple[float, float]

WALL_THICKNESS_M = 0.15
_FILL_M = WALL_THICKNESS_M / 2 - 0.002  # a corner is filled to just behind the other wall's face: no two faces coincide
_EPS = 1e-6


class LayoutError(ValueError):
    """A layout that cannot be generated; one line."""


@dataclass(frozen=True)
class Rect:
    """Axis-aligned rectangle on the floor, m."""

    x0: float
    y0: float
    x1: float
    y1: float

    def __post_init__(self) -> None:
        if self.x1 - self.x0 <= 0 or self.y1 - self.y0 <= 0:
            raise LayoutError(f"rectangle without area: {self.x0}, {self.y0}, {self.x1}, {self.y1}")

    @property
    def width(self) -> float:
        """Extent along x, m."""
        return self.x1 - self.x0

    @property
    def depth(self) -> float:
        """Extent along y, m."""
        return self.y1 - self.y0

    @property
    def centre(self) -> Vec2:
        """Centre, m."""
        return ((self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2)

    def grown(self, margin_m: float) -> Rect:
        """Return the rectangle with every side moved outwards (negative: inwards)."""
        return Rect(self.x0 - margin_m, self.y0 - margin_m, self.x1 + margin_m, self.y1 + margin_m)

    def overlaps(self, other: Rect) -> bool:
        """Return whether two rectangles overlap by more than a border."""
        apart_x = self.x1 <= other.x0 + _EPS or other.x1 <= self.x0 + _EPS
        apart_y = self.y1 <= other.y0 + _EPS or other.y1 <= self.y0 + _EPS
        return not (apart_x or apart_y)

    def corners(self) -> tuple[Vec2, ...]:
        """Return the corners, counter-clockwise."""
        return ((self.x0, self.y0), (self.x1, self.y0), (self.x1, self.y1), (self.x0, self.y1))


@dataclass(frozen=True)
class Border:
    """Border segment shared by two rectangles: along x at y = `at`, or along y at x = `at`, from `low` to `high`."""

    along_x: bool
    at: float
    low: float
    high: float

    @property
    def middle(self) -> Vec2:
        """Middle of the segment, m."""
        along = (self.low + self.high) / 2
        return (along, self.at) if self.along_x else (self.at, along)

    @property
    def length(self) -> float:
        """Length of the segment, m."""
        return self.high - self.low

    def cut(self, low: float, high: float) -> Border:
        """Return a part of the segment."""
        return Border(self.along_x, self.at, low, high)


def shared_border(a: Rect, b: Rect) -> Border:
    """Return the shared border of two rectangles. Raises LayoutError if they do not touch."""
    for along_x, at_a, at_b, low, high in (
        (True, a.y1, b.y0, max(a.x0, b.x0), min(a.x1, b.x1)),
        (True, a.y0, b.y1, max(a.x0, b.x0), min(a.x1, b.x1)),
        (False, a.x1, b.x0, max(a.y0, b.y0), min(a.y1, b.y1)),
        (False, a.x0, b.x1, max(a.y0, b.y0), min(a.y1, b.y1)),
    ):
        if abs(at_a - at_b) < _EPS and high - low > _EPS:
            return Border(along_x, at_a, low, high)
    raise LayoutError("the two rectangles do not touch")


def _merged(spans: list[Vec2]) -> list[list[float]]:
    out: list[list[float]] = []
    for low, high in sorted(spans):
        if out and low <= out[-1][1] + _EPS:
            out[-1][1] = max(out[-1][1], high)
        else:
            out.append([low, high])
    return out


def _without(spans: list[list[float]], gaps: list[Vec2]) -> list[Vec2]:
    rest = [(low, high) for low, high in spans]
    for gap_low, gap_high in gaps:
        cut: list[Vec2] = []
        for low, high in rest:
            if gap_high <= low + _EPS or gap_low >= high - _EPS:
                cut.append((low, high))
                continue
            if gap_low > low + _EPS:
                cut.append((low, gap_low))
            if gap_high < high - _EPS:
                cut.append((gap_high, high))
        rest = cut
    return rest


def wall_lines(rects: list[Rect], openings: list[Border]) -> list[tuple[Vec2, Vec2]]:
    """Return the walls' centre lines around all rectangles without the openings; corners are filled once."""
    lines: dict[tuple[bool, float], list[Vec2]] = defaultdict(list)
    for rect in rects:
        for along_x, at, low, high in (
            (True, rect.y0, rect.x0, rect.x1),
            (True, rect.y1, rect.x0, rect.x1),
            (False, rect.x0, rect.y0, rect.y1),
            (False, rect.x1, rect.y0, rect.y1),
        ):
            lines[along_x, round(at, 3)].append((low, high))
    gaps: dict[tuple[bool, float], list[Vec2]] = defaultdict(list)
    for gap in openings:
        gaps[gap.along_x, round(gap.at, 3)].append((gap.low, gap.high))
    pieces = {key: _without(_merged(spans), gaps[key]) for key, spans in sorted(lines.items())}
    upright = [(at, low, high) for (along_x, at), spans in pieces.items() if not along_x for low, high in spans]
    out: list[tuple[Vec2, Vec2]] = []
    for (along_x, at), spans in pieces.items():
        for low, high in spans:
            if not along_x:
                out.append(((at, low), (at, high)))
                continue
            # A corner needs filling only where two walls end in one point.
            first = low - _FILL_M * _ends_there(upright, low, at)
            last = high + _FILL_M * _ends_there(upright, high, at)
            out.append(((first, at), (last, at)))
    return out


def _ends_there(upright: list[tuple[float, float, float]], x: float, y: float) -> bool:
    touching = [s for s in upright if abs(s[0] - x) < 1e-3 and s[1] - 1e-3 <= y <= s[2] + 1e-3]
    return bool(touching) and not any(low + 1e-3 < y < high - 1e-3 for _, low, high in touching) and len(touching) == 1
