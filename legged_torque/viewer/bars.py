"""What a page shows as text with bars: torques, reward terms, the gait."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np

REWARD, PENALTY, STANCE = "#1faa55", "#e03131", "#343a40"


def gait_html(names: Sequence[str], contacts: np.ndarray, seconds: int) -> str:
    """Return a gait diagram: a row per foot, dark while it is on the ground, and the share of that time.

    Args:
        names: Of the feet.
        contacts: 1 for a foot on the ground, else 0; the last step is now. Shape: (steps, feet).
        seconds: That the whole width stands for.
    """
    steps = 50 * seconds
    rows = []
    for name, column in zip(names, contacts.T > 0, strict=True):
        changes = np.flatnonzero(np.diff(column.astype(int), prepend=0, append=0)) + steps - len(column)
        path = "".join(f"M{begin} 0V1H{end}V0z" for begin, end in changes.reshape(-1, 2))
        picture = f'<path d="{path}" fill="{STANCE}"/>'
        view = f'viewBox="0 0 {steps} 1" preserveAspectRatio="none"'
        track = f'<svg {view} style="flex:1;height:12px;background:#8882;border-radius:2px">{picture}</svg>'
        rows.append(line_html(name.replace("_", " "), track, f"{100 * column.mean():.0f} %"))
    return block_html(f"Feet on the ground, last {seconds} s", rows)


def reward_bars(rewards: dict[str, float]) -> str:
    """Return weighted reward terms as bars, rewards in green and penalties in red."""
    largest = max(map(abs, rewards.values()), default=1.0) or 1.0
    rows = [
        row_html(name.replace("_", " "), [(value / largest, REWARD if value > 0 else PENALTY)], f"{value:+.3f}", 116)
        for name, value in rewards.items()
    ]
    return block_html(f"Weighted terms [1/s]; their sum: {sum(rewards.values()):+.3f}", rows)


def legend_html(series: list[tuple[str, str]]) -> str:
    """Return names with colored dots."""
    dot = '<span style="margin-right:12px;white-space:nowrap"><span style="color:{}">&#9679;</span> {}</span>'
    dots = "".join(dot.format(color, name) for name, color in series)
    return f'<div style="font-size:12px;padding:2px 10px">{dots}</div>'


def block_html(title: str, rows: list[str]) -> str:
    """Return rows below a title."""
    return f'<div style="font-size:12px;padding:4px 10px"><b>{title}</b>{"".join(rows)}</div>'


def row_html(name: str, bars: list[tuple[float, str]], text: str, name_width: int = 52) -> str:
    """Return a name, bars from a middle line (lengths from -1 to 1, and colors), and a number."""
    height = 12 // len(bars)
    drawn = ""
    for i, (value, color) in enumerate(bars):
        length = 50.0 * min(abs(value), 1.0)
        left = 50.0 - length if value < 0 else 50.0
        place = f"left:{left:.1f}%;width:{length:.1f}%;top:{1 + i * height}px;height:{height}px"
        drawn += f'<div style="position:absolute;{place};background:{color}"></div>'
    line = '<div style="position:absolute;left:50%;width:1px;height:14px;background:#868e96"></div>'
    track = f'<div style="position:relative;flex:1;height:14px;background:#8882;border-radius:2px">{drawn}{line}</div>'
    return line_html(name, track, text, name_width)


def line_html(name: str, track: str, text: str, name_width: int = 52) -> str:
    """Return a name, what is drawn, and a number."""
    return (
        '<div style="display:flex;align-items:center;gap:6px;height:17px">'
        f'<span style="width:{name_width}px;white-space:nowrap">{html.escape(name)}</span>{track}'
        f'<span style="width:58px;text-align:right;font-variant-numeric:tabular-nums">{text}</span></div>'
    )
