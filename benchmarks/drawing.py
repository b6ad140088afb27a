"""Drawings of the pages, made without a library: curves, and flame graphs.

`python -m benchmarks.drawing FOLDED SVG TITLE` draws the stacks that `py-spy record -f raw` wrote,
without calls that took less than one in 100.
"""

import sys
from collections.abc import Sequence
from html import escape
from math import log10
from pathlib import Path
from typing import NamedTuple

_LEAST = 0.01  # share of the samples of a call that is drawn
_ROW, _WIDE = 16, 1000  # pixels of a call, and of all samples
_LETTER = 6.2  # pixels
_OUTER = "Runner.run"  # calls below it: the work of the event loop
_COLOURS = ("#f4a261", "#e9c46a", "#e76f51", "#f2b880", "#d9a441")


class Curve(NamedTuple):
    """Points over a logarithmic axis, each marked with its value."""

    title: str
    axis: str
    points: Sequence[tuple[float, float]]
    band: float  # the greatest ratio of two values that counts as flat


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    size = f'width="{width:g}" height="{height:g}" viewBox="0 0 {width:g} {height:g}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">'
    white = f'<rect width="{width:g}" height="{height:g}" fill="#ffffff"/>'
    return "\n".join((head, white, *parts, "</svg>\n"))


def _text(x: float, y: float, text: str, *, size: int = 11, anchor: str = "start") -> str:
    place = f'x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="{anchor}"'
    return f'<text {place} fill="#222222">{escape(text)}</text>'


def curves(found: Sequence[Curve]) -> str:
    """Returns an SVG with the curves side by side. The grey band is flat enough."""
    wide, high, left, top = 360, 220, 30, 50
    parts = []
    for number, curve in enumerate(found):
        x0 = number * (wide + 2 * left) + left
        first, last = log10(curve.points[0][0]), log10(curve.points[-1][0])
        least = min(value for _, value in curve.points)
        most = 1.25 * max(*(value for _, value in curve.points), least * curve.band)

        def y(value: float, most: float = most) -> float:
            return top + high * (1 - value / most)

        flat = y(least * curve.band)
        band = f'y="{flat:.1f}" width="{wide}" height="{y(least) - flat:.1f}" fill="#e5e5e5"'
        parts.append(_text(x0, top - 25, curve.title, size=13))
        parts.append(f'<rect x="{x0}" {band}/>')
        parts.append(f'<path d="M{x0} {top}v{high}h{wide}" fill="none" stroke="#888888"/>')
        places = []
        for size, value in curve.points:
            x = x0 + 10 + (wide - 30) * (log10(size) - first) / (last - first)
            places.append(f"{x:.1f} {y(value):.1f}")
            parts.append(f'<circle cx="{x:.1f}" cy="{y(value):.1f}" r="3" fill="#1f6feb"/>')
            parts.append(_text(x, y(value) - 8, f"{value:.1f}", anchor="middle"))
            parts.append(_text(x, top + high + 15, f"{size:,.0f}", anchor="middle"))
        parts.append(f'<path d="M{"L".join(places)}" fill="none" stroke="#1f6feb"/>')
        parts.append(_text(x0 + wide / 2, top + high + 32, curve.axis, anchor="middle"))
    return _svg(len(found) * (wide + 2 * left), top + high + 45, parts)


class _Call:
    """A function in the stacks, with the samples of all below it."""

    def __init__(self) -> None:
        self.samples = 0
        self.below: dict[str, _Call] = {}

    def add(self, names: Sequence[str], samples: int) -> None:
        self.samples += samples
        if names:
            self.below.setdefault(names[0], _Call()).add(names[1:], samples)


def flames(folded: str, title: str) -> str:
    """Returns the SVG of stacks: one a row, functions with `;` between them, then the samples."""
    root = _Call()
    for row in folded.splitlines():
        stack, _, samples = row.rpartition(" ")
        names = [name.split(" (")[0] for name in stack.split(";")]
        begin = names.index(_OUTER) + 1 if _OUTER in names else 0
        root.add(names[begin:] or ["(waits)"], int(samples))
    parts: list[str] = []
    depth = _rows(root, root.samples, 0.0, 0, parts)
    parts.insert(0, _text(4, 16, f"{title}: {root.samples:,} samples", size=13))
    return _svg(_WIDE, 24 + depth * _ROW + 4, parts)


def _rows(call: _Call, all_samples: int, x: float, row: int, parts: list[str]) -> int:
    """Draws the calls below, the longest first. Returns the number of rows."""
    deepest = row
    for name, below in sorted(call.below.items(), key=lambda item: -item[1].samples):
        if below.samples < _LEAST * all_samples:
            break
        wide, y = _WIDE * below.samples / all_samples, 24 + row * _ROW
        colour = _COLOURS[sum(name.encode()) % len(_COLOURS)]
        box = f'x="{x:.1f}" y="{y}" width="{wide:.1f}" height="{_ROW - 1}" fill="{colour}"'
        share = f"{name}: {below.samples / all_samples:.1%}"
        parts.append(f"<rect {box}><title>{escape(share)}</title></rect>")
        if (letters := int(wide / _LETTER) - 1) >= 4:
            shown = name if len(name) <= letters else name[: letters - 1] + "…"
            parts.append(_text(x + 2, y + 11, shown, size=10))
        deepest = max(deepest, _rows(below, all_samples, x, row + 1, parts))
        x += wide
    return max(deepest, row)


if __name__ == "__main__":
    source, target, title = sys.argv[1:]
    Path(target).write_text(flames(Path(source).read_text(), title))
