"""The plots of the page: velocities, torques and reward terms of the followed world."""

from __future__ import annotations

import html

import numpy as np
import viser

from legged_torque.viewer.recording import HISTORY_STEPS
from legged_torque.viewer.session import Session
from legged_torque.viewer.state import State

COMMAND, ACTUAL, PD, DIRECT, TOTAL = "#1faa55", "#2f7df6", "#f08c00", "#2f7df6", "#343a40"
VELOCITIES = ("v_x, forward [m/s]", "v_y, to the left [m/s]", "yaw rate, to the left [rad/s]")
STRIDE = 2
"""Every how many control steps there is a point in a plot."""
WIDTH = 380
"""Of the panel [pixels]."""


class Plots:
    """The panel with plots."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        """Build the panel, at the left of the page.

        Args:
            server: The page.
            session: What is watched.
        """
        gui, self._session = server.gui, session
        self._joints = [name.removesuffix("_joint") for name in session.task.dof_names]
        self._limits = session.task.torque_limits[1].tolist()
        self._is_mixed = session.state.mixing is not None
        empty = np.zeros(2, np.float32)
        panel = gui.add_panel()
        with panel.add_tab("Walking", viser.Icon.ACTIVITY):
            legend = [("commanded", COMMAND), ("actual", ACTUAL)]
            gui.add_html(legend_html(legend))
            self._velocities = [add_plot(gui, title, legend, (-1.6, 1.6)) for title in VELOCITIES]
            self._bars = gui.add_html("")
        with panel.add_tab("Joints", viser.Icon.ROBOT):
            self._leg = gui.add_dropdown("leg", tuple(dict.fromkeys(name.split("_")[0] for name in self._joints)))
            series = self._torque_series()
            gui.add_html(legend_html(series))
            names = ("hip", "thigh", "calf")
            self._torques = [add_plot(gui, f"torque of the {name} [N m]", series) for name in names]
        with panel.add_tab("Rewards", viser.Icon.TROPHY):
            self._rewards = gui.add_html("")
        panel.dock_left()
        panel.set_width(WIDTH)
        self._empty = empty

    def _torque_series(self) -> list[tuple[str, str]]:
        """Return names and colors of the torques that are plotted."""
        parts = [("PD part", PD), ("torque part", DIRECT)] if self._is_mixed else []
        return [*parts, ("applied", TOTAL)]

    def update(self, state: State) -> None:
        """Draw everything anew.

        Args:
            state: The session's newest state.
        """
        if state.reading is None:
            return
        past = self._session.history.read(len(self._joints))
        chosen = slice(
            len(past["time"]) % STRIDE, None, STRIDE
        )  # the same steps every time, so that curves do not jitter
        time = past["time"][chosen]
        if len(time) > 1:
            time = (time - state.time).astype(np.float32)
            for i, plot in enumerate(self._velocities):
                plot.data = (time, *(past[name][chosen, i].astype(np.float32) for name in ("commands", "velocities")))
            names = ("pd", "direct", "torques") if self._is_mixed else ("torques",)
            joints = [i for i, name in enumerate(self._joints) if name.split("_")[0] == self._leg.value]
            for joint, plot in zip(joints, self._torques, strict=False):
                plot.data = (time, *(past[name][chosen, joint].astype(np.float32) for name in names))
        self._bars.content = self._torque_bars(state)
        self._rewards.content = reward_bars(state.rewards)

    def _torque_bars(self, state: State) -> str:
        """Return all torques of this moment as bars; those of the multi-head task in two parts."""
        pd, direct = state.reading.torque_parts
        rows = []
        for i, name in enumerate(self._joints):
            parts = [(pd[i], PD), (direct[i], DIRECT)] if self._is_mixed else [(state.reading.torques[i], DIRECT)]
            bars = [(value / self._limits[i], color) for value, color in parts]
            rows.append(row_html(name.replace("_", " "), bars, f"{state.reading.torques[i]:+.1f}"))
        title = f"Torques [N m], up to {self._limits[0]:.1f}"
        if self._is_mixed:
            theta = state.mixing
            title += legend_html([(f"PD part x {theta[0]:.2f}", PD), (f"torque part x {theta[1]:.2f}", DIRECT)])
        return block_html(title, rows)


def add_plot(
    gui: viser.GuiApi, title: str, series: list[tuple[str, str]], limits: tuple[float, float] | None = None
) -> viser.GuiUplotHandle:
    """Add a plot over the last seconds.

    Args:
        gui: Where.
        title: What is plotted, with its unit.
        series: Name and color of each curve.
        limits: Lowest and highest value; None are those that occur.
    """
    lines = [{"label": name, "stroke": color, "width": 1.5, "points": {"show": False}} for name, color in series]
    seconds = HISTORY_STEPS // 50
    values = {"auto": True} if limits is None else {"auto": False, "range": limits}
    return gui.add_uplot(
        tuple(np.zeros(2, np.float32) for _ in range(len(series) + 1)),
        ({"label": "s"}, *lines),
        title=title,
        scales={"x": {"time": False, "auto": False, "range": (-seconds, 0)}, "y": values},
        axes=({"size": 24, "font": "10px sans-serif"}, {"size": 38, "font": "10px sans-serif"}),
        legend={"show": False},
        height=128,
    )


def reward_bars(rewards: dict[str, float]) -> str:
    """Return weighted reward terms as bars, rewards in green and penalties in red."""
    largest = max(map(abs, rewards.values()), default=1.0) or 1.0
    rows = [
        row_html(
            name.replace("_", " "), [(value / largest, "#1faa55" if value > 0 else "#e03131")], f"{value:+.3f}", 116
        )
        for name, value in rewards.items()
    ]
    return block_html(f"Weighted terms [1/s]; their sum: {sum(rewards.values()):+.3f}", rows)


def legend_html(series: list[tuple[str, str]]) -> str:
    """Return names with colored dots."""
    dots = (
        f'<span style="margin-right:12px;white-space:nowrap"><span style="color:{color}">&#9679;</span> {name}</span>'
        for name, color in series
    )
    return f'<div style="font-size:12px;padding:2px 10px">{"".join(dots)}</div>'


def block_html(title: str, rows: list[str]) -> str:
    """Return rows below a title."""
    return f'<div style="font-size:12px;padding:4px 10px"><b>{title}</b>{"".join(rows)}</div>'


def row_html(name: str, bars: list[tuple[float, str]], text: str, name_width: int = 52) -> str:
    """Return a name, bars from a middle line, and a number.

    Args:
        name: The name.
        bars: Length of each bar, from -1 to 1, and its color.
        text: The number.
        name_width: [pixels].
    """
    height = 12 // len(bars)
    drawn = ""
    for i, (value, color) in enumerate(bars):
        length = 50.0 * min(abs(value), 1.0)
        left = 50.0 - length if value < 0 else 50.0
        place = f"left:{left:.1f}%;width:{length:.1f}%;top:{1 + i * height}px;height:{height}px"
        drawn += f'<div style="position:absolute;{place};background:{color}"></div>'
    line = '<div style="position:absolute;left:50%;width:1px;height:14px;background:#868e96"></div>'
    track = f'<div style="position:relative;flex:1;height:14px;background:#8882;border-radius:2px">{drawn}{line}</div>'
    return (
        '<div style="display:flex;align-items:center;gap:6px;height:17px">'
        f'<span style="width:{name_width}px">{html.escape(name)}</span>{track}'
        f'<span style="width:46px;text-align:right;font-variant-numeric:tabular-nums">{text}</span></div>'
    )
