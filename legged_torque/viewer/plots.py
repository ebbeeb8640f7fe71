"""The panel with plots: velocities, gait, joints and reward terms of the followed world."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
import viser

from legged_torque.envs.base.asset import Asset
from legged_torque.viewer.session import HISTORY_STEPS, Session
from legged_torque.viewer.snapshot import Snapshot

Series = list[tuple[str, str]]  # names and colors

COMMAND, ACTUAL, APPLIED, COMPANION = "#1faa55", "#2f7df6", "#343a40", "#f08c00"
PARTS = ("#f08c00", "#2f7df6", "#ae3ec9", "#1faa55")  # colors of the parts of torques
VELOCITIES = ("v_x, forward [m/s]", "v_y, to the left [m/s]", "yaw rate, to the left [rad/s]")
VELOCITY_LIMITS = (-1.6, 1.6)
STRIDE = 2  # control steps per point of a plot
WIDTH = 300  # of the panel [pixels]
GAIT_STEPS = HISTORY_STEPS // 2  # control steps in the gait diagram
SUM = "sum of all"  # of the reward terms
REWARD, PENALTY, STANCE, MIDDLE = "#1faa55", "#e03131", "#343a40", "#868e96"
NAME, LONG_NAME = 52, 116  # widths of names [pixels]


class Plots:
    """The panel with plots."""

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        """Build the panel at the left of the page."""
        task, self._session = session.task, session
        self._joints = [name.removesuffix("_joint") for name in task.dof_names]
        self._legs = joints_by_leg(self._joints, task.cfg.asset.mirrored_legs)
        self._limits = task.torque_limits.abs().amax(dim=0).tolist()
        self._feet = foot_labels(task.asset)
        self._terms = task.reward_names
        seconds = HISTORY_STEPS * task.dt
        names = [name.replace("_", " ") for name in session.mixing]
        self._parts = [(name, PARTS[i % len(PARTS)]) for i, name in enumerate(names)]
        self._has_targets = any(term.name == "position_residual" for term in task.control_law.terms)
        panel = gui.add_panel()
        with panel.add_tab("Walking", viser.Icon.ACTIVITY):
            lines = [("commanded", COMMAND), ("actual", ACTUAL), ("companion", COMPANION)]
            lines = lines if session.companion else lines[:2]
            self._velocities = add_plots(gui, seconds, VELOCITIES, lines, VELOCITY_LIMITS)
            self._gait, self._bars = gui.add_html(""), gui.add_html("")
        with panel.add_tab("Joints", viser.Icon.ROBOT):
            self._leg = gui.add_dropdown("leg", tuple(self._legs))
            titles = [""] * max(map(len, self._legs.values()))
            self._torques = add_plots(gui, seconds, titles, [*self._parts, ("applied", APPLIED)])
            lines = [("target", COMMAND), ("position", ACTUAL)]
            self._angles = add_plots(gui, seconds, titles, lines if self._has_targets else lines[1:])
            self._leg.on_update(lambda event: self._choose_leg())
            self._choose_leg()
        with panel.add_tab("Rewards", viser.Icon.TROPHY):
            self._term = gui.add_dropdown("over time", (SUM, *self._terms))
            self._reward = add_plots(gui, seconds, ["weighted, per second"], [("term", ACTUAL)])
            self._rewards = gui.add_html("")
        panel.dock_left()
        panel.set_width(WIDTH)

    def update(self) -> None:
        """Draw everything."""
        session, past = self._session, list(self._session.history)
        if len(past) < 2 * STRIDE:
            return
        feet = np.array([snapshot.feet for snapshot in past[-GAIT_STEPS:]])
        self._gait.content = gait_html(self._feet, feet, GAIT_STEPS, round(GAIT_STEPS * session.task.dt, 1))
        self._bars.content = self._torque_bars(past[-1])
        self._rewards.content = reward_bars(dict(zip(self._terms, session.rewards.tolist(), strict=True)))
        self._draw_curves(past[len(past) % STRIDE :: STRIDE], past[-1].time)  # always the same steps, against jitter

    def _choose_leg(self) -> None:
        """Write the names of the chosen leg's joints above the plots."""
        self._chosen = self._legs[self._leg.value]
        for title, plots in (("torque of {} [N m]", self._torques), ("angle of {} [rad]", self._angles)):
            for i, plot in enumerate(plots):
                plot.visible = i < len(self._chosen)
                if plot.visible:
                    plot.title = title.format(self._joints[self._chosen[i]].replace("_", " "))

    def _draw_curves(self, past: Sequence[Snapshot], now: float) -> None:
        """Draw some snapshots over their time before ``now`` [s]."""
        time = np.array([one.time for one in past]) - now
        velocities = [np.array([(one.commands[one.world], one.velocities[one.world]) for one in past])]
        if self._session.companion:
            velocities.append(self._companion_velocities(past)[:, None])
        draw(self._velocities, time, np.concatenate(velocities, axis=1))
        torques = np.array([[*one.torque_parts, one.torques] for one in past])
        draw(self._torques, time, torques[:, :, self._chosen])
        positions = np.array([one.qpos[one.world, -len(self._joints) :] for one in past])
        targets = np.array([one.targets for one in past])
        angles = np.stack([targets, positions] if self._has_targets else [positions], axis=1)
        draw(self._angles, time, angles[:, :, self._chosen])
        rewards = np.array([one.rewards for one in past])
        shown = rewards.sum(axis=1) if self._term.value == SUM else rewards[:, self._terms.index(self._term.value)]
        draw(self._reward, time, shown[:, None, None])

    def _companion_velocities(self, past: Sequence[Snapshot]) -> np.ndarray:
        """Return the velocities of the companion's robot at the times of snapshots, or NaN. Shape: (steps, 3)."""
        assert self._session.companion
        known = {round(one.time, 4): one.velocities[0] for one in list(self._session.companion.history)}
        return np.array([known.get(round(one.time, 4), np.full(3, np.nan)) for one in past])

    def _torque_bars(self, snapshot: Snapshot) -> str:
        """Return the present torques as bars, in parts if the task mixes action terms."""
        colors = [color for _, color in self._parts] or [ACTUAL]
        parts = snapshot.torque_parts if self._parts else snapshot.torques[None]
        rows = []
        for name, values, torque, limit in zip(self._joints, parts.T, snapshot.torques, self._limits, strict=True):
            bars = [(value / limit, color) for value, color in zip(values, colors, strict=True)]
            rows.append(bars_html(name, bars, f"{torque:+.1f}/{limit:.0f}"))
        weights = zip(self._parts, self._session.mixing.values(), strict=True)
        legend = legend_html([(f"{name} x {weight:.2f}", color) for (name, color), weight in weights])
        return block_html("Torques and their limits [N m]" + legend, rows)


def foot_labels(asset: Asset) -> list[str]:
    """Return a name for each foot, which may have several geoms: the first word of one, if that makes a difference."""
    names = [asset.foot_names[asset.foot_of.index(foot)] for foot in dict.fromkeys(asset.foot_of)]
    words = [name.split("_")[0] for name in names]
    return words if len(set(words)) == len(words) else names


def joints_by_leg(joints: Sequence[str], mirrored_legs: Sequence[Sequence[str]]) -> dict[str, list[int]]:
    """Return the indices of the joints of each leg of ``asset.mirrored_legs``, and all others as "other"."""
    legs = [leg for pair in mirrored_legs for leg in pair]
    result: dict[str, list[int]] = {}
    for place, name in enumerate(joints):
        leg = next((leg for leg in legs if name.startswith(leg)), "other")
        result.setdefault(leg, []).append(place)
    return result


def add_plots(
    gui: viser.GuiApi,
    seconds: float,
    titles: Sequence[str],
    series: Series,
    limits: tuple[float, float] | None = None,
) -> list[viser.GuiUplotHandle]:
    """Add plots of equal series over the last seconds, below a legend; limits of None are those of the data."""
    if len(series) > 1:
        gui.add_html(legend_html(series))
    lines = [{"label": name, "stroke": color, "width": 1.5, "points": {"show": False}} for name, color in series]
    values = {"auto": True} if limits is None else {"auto": False, "range": limits}
    settings = {
        "scales": {"x": {"time": False, "auto": False, "range": (-seconds, 0)}, "y": values},
        "axes": ({"size": 24, "font": "10px sans-serif"}, {"size": 38, "font": "10px sans-serif"}),
        "legend": {"show": False},
        "height": 128,  # [pixels]
    }
    nothing = (np.zeros(2),) * (len(series) + 1)
    return [gui.add_uplot(nothing, ({"label": "s"}, *lines), title=title, **settings) for title in titles]


def draw(plots: Sequence[viser.GuiUplotHandle], time: np.ndarray, curves: np.ndarray) -> None:
    """Draw curves over time, one plot per item of the last axis. Shapes: (steps,), (steps, series, plots)."""
    for plot, series in zip(plots, np.moveaxis(curves, 2, 0), strict=False):
        plot.data = (time, *series.T)


def gait_html(names: Sequence[str], contacts: np.ndarray, steps: int, seconds: float) -> str:
    """Return a gait diagram of some steps with a row per foot, dark while it is on the ground, and their share.

    Contacts are 1 on the ground, else 0; the last one is now. Shape: (at most ``steps``, feet).
    """
    rows = []
    for name, column in zip(names, contacts.T > 0, strict=True):
        changes = np.flatnonzero(np.diff(column.astype(int), prepend=0, append=0)) + steps - len(column)
        path = "".join(f"M{begin} 0V1H{end}V0z" for begin, end in changes.reshape(-1, 2))
        rows.append(row_html(name, f"0 0 {steps} 1", [(path, STANCE)], f"{100 * column.mean():.0f} %"))
    return block_html(f"Feet on the ground, last {seconds:g} s", rows)


def reward_bars(rewards: dict[str, float]) -> str:
    """Return weighted reward terms as bars, rewards in green and penalties in red."""
    largest = max(map(abs, rewards.values()), default=1.0) or 1.0
    rows = [
        bars_html(name, [(value / largest, REWARD if value > 0 else PENALTY)], f"{value:+.3f}", LONG_NAME)
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


def bars_html(name: str, bars: list[tuple[float, str]], text: str, name_width: int = NAME) -> str:
    """Return a row of bars from its middle, with their lengths from -1 to 1 and colors, between a name and a text."""
    shapes = [(f"M0 {i}V{i + 1}H{np.clip(value, -1, 1):.3f}V{i}z", color) for i, (value, color) in enumerate(bars)]
    middle = (f"M-.004 0V{len(bars)}H.004V0z", MIDDLE)
    return row_html(name, f"-1 0 2 {len(bars)}", [*shapes, middle], text, name_width)


def row_html(name: str, view: str, shapes: list[tuple[str, str]], text: str, name_width: int = NAME) -> str:
    """Return a row with an SVG of paths and colors in a view box, between a name and a text."""
    paths = "".join(f'<path d="{path}" fill="{color}"/>' for path, color in shapes)
    style = "flex:1;min-width:0;height:13px;background:#8882;border-radius:2px"
    return (
        '<div style="display:flex;align-items:center;gap:6px;height:17px">'
        f'<span style="width:{name_width}px;white-space:nowrap">{html.escape(name.replace("_", " "))}</span>'
        f'<svg viewBox="{view}" preserveAspectRatio="none" style="{style}">{paths}</svg>'
        f'<span style="width:58px;text-align:right;font-variant-numeric:tabular-nums">{text}</span></div>'
    )
