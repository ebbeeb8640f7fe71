"""The plots of the page: velocities, torques and reward terms of the followed world."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
import viser

from legged_torque.viewer.reading import Reading
from legged_torque.viewer.session import HISTORY_STEPS, Session
from legged_torque.viewer.state import SessionState

COMMAND, ACTUAL, APPLIED = "#1faa55", "#2f7df6", "#343a40"
PARTS = ("#f08c00", "#2f7df6", "#ae3ec9", "#1faa55")  # colors of the parts of torques
REWARD, PENALTY = "#1faa55", "#e03131"
VELOCITIES = ("v_x, forward [m/s]", "v_y, to the left [m/s]", "yaw rate, to the left [rad/s]")
STRIDE = 2  # plots show every second control step
WIDTH = 380  # of the panel [pixels]


class Plots:
    """The panel with plots."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        """Build the panel, at the left of the page."""
        gui, task, self._session = server.gui, session.task, session
        self._joints = [name.removesuffix("_joint") for name in task.dof_names]
        self._legs = joints_by_leg(self._joints, task.cfg.asset.mirrored_legs)
        self._limits = task.torque_limits[1].tolist()
        parts = [name.replace("_", " ") for name in session.state.mixing]
        self._parts = [(name, PARTS[i % len(PARTS)]) for i, name in enumerate(parts)]
        panel = gui.add_panel()
        with panel.add_tab("Walking", viser.Icon.ACTIVITY):
            legend = [("commanded", COMMAND), ("actual", ACTUAL)]
            gui.add_html(legend_html(legend))
            self._velocities = [add_plot(gui, title, legend, (-1.6, 1.6)) for title in VELOCITIES]
            self._bars = gui.add_html("")
        with panel.add_tab("Joints", viser.Icon.ROBOT):
            self._leg = gui.add_dropdown("leg", tuple(self._legs))
            series = [*self._parts, ("applied", APPLIED)]
            gui.add_html(legend_html(series))
            most = max(len(joints) for joints in self._legs.values())
            self._torques = [add_plot(gui, "torque", series) for _ in range(most)]
            self._leg.on_update(lambda event: self._choose_leg())
            self._choose_leg()
        with panel.add_tab("Rewards", viser.Icon.TROPHY):
            self._rewards = gui.add_html("")
        panel.dock_left()
        panel.set_width(WIDTH)

    def update(self, state: SessionState) -> None:
        """Draw everything anew."""
        if state.reading is not None:
            self._update_curves(state.time)
            self._bars.content = self._torque_bars(state.reading, state.mixing)
            self._rewards.content = reward_bars(state.rewards)

    def _choose_leg(self) -> None:
        """Write the chosen leg's joints above the plots of torques."""
        self._chosen = self._legs[self._leg.value]
        for i, plot in enumerate(self._torques):
            plot.visible = i < len(self._chosen)
            if plot.visible:
                plot.title = f"torque of {self._joints[self._chosen[i]].replace('_', ' ')} [N m]"

    def _update_curves(self, now: float) -> None:
        """Draw the last seconds before a simulated time [s]."""
        past = list(self._session.history)
        past = past[len(past) % STRIDE :: STRIDE]  # the same steps every time, so that curves do not jitter
        if len(past) < 2:
            return
        time = np.array([reading.time - now for reading in past], np.float32)
        velocities = np.array([(one.commands[one.world], one.velocities[one.world]) for one in past])
        for i, plot in enumerate(self._velocities):
            plot.data = (time, *velocities[:, :, i].T)
        torques = np.array([[*reading.torque_parts, reading.torques] for reading in past])
        for plot, joint in zip(self._torques, self._chosen, strict=False):
            plot.data = (time, *torques[:, :, joint].T)

    def _torque_bars(self, reading: Reading, mixing: dict[str, float]) -> str:
        """Return all torques of this moment as bars, in parts if the task mixes action terms."""
        rows = []
        for i, name in enumerate(self._joints):
            colors = [color for _, color in self._parts] or [ACTUAL]
            values = reading.torque_parts[:, i] if self._parts else reading.torques[i : i + 1]
            bars = [(value / self._limits[i], color) for value, color in zip(values, colors, strict=True)]
            rows.append(row_html(name.replace("_", " "), bars, f"{reading.torques[i]:+.1f}"))
        title = f"Torques [N m], up to {max(self._limits):.1f}"
        if self._parts:
            weights = zip(self._parts, mixing.values(), strict=True)
            title += legend_html([(f"{name} x {weight:.2f}", color) for (name, color), weight in weights])
        return block_html(title, rows)


def joints_by_leg(joints: Sequence[str], mirrored_legs: Sequence[Sequence[str]]) -> dict[str, list[int]]:
    """Return the places of the joints of each leg of ``asset.mirrored_legs``, and those of no leg as "other"."""
    legs = [leg for pair in mirrored_legs for leg in pair]
    result: dict[str, list[int]] = {}
    for place, name in enumerate(joints):
        leg = next((leg for leg in legs if name.startswith(leg)), "other")
        result.setdefault(leg, []).append(place)
    return result


def add_plot(
    gui: viser.GuiApi, title: str, series: list[tuple[str, str]], limits: tuple[float, float] | None = None
) -> viser.GuiUplotHandle:
    """Add a plot over the last seconds: ``series`` are names and colors, ``limits`` of None those of the data."""
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
    return (
        '<div style="display:flex;align-items:center;gap:6px;height:17px">'
        f'<span style="width:{name_width}px">{html.escape(name)}</span>{track}'
        f'<span style="width:46px;text-align:right;font-variant-numeric:tabular-nums">{text}</span></div>'
    )
