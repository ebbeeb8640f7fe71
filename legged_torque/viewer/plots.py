"""The panel with plots: velocities, gait, joints and reward terms of the followed world."""

import html
from collections.abc import Iterable, Sequence
from itertools import cycle

import numpy as np
import viser
from numpy.typing import ArrayLike

from legged_torque.utils.metrics import UNITS
from legged_torque.utils.mjcf import joint_limits
from legged_torque.viewer.session import HISTORY_STEPS, Session
from legged_torque.viewer.snapshot import PD_CONTROL, Snapshot

Series = Iterable[tuple[str, str]]  # names and colors
Row = tuple[str, str, Sequence[str]]  # name, color of its dot or nothing, and texts

COMMAND, ACTUAL, APPLIED, COMPANION = "#1faa55", "#2f7df6", "#343a40", "#f08c00"
PARTS = ("#f08c00", "#2f7df6", "#ae3ec9", "#1faa55")  # colors of the parts of torques
REWARD, PENALTY, LIMIT, STANCE, MIDDLE = "#1faa55", "#e03131", "#e03131", "#343a40", "#868e96"
VELOCITIES = ("v_x, forward [m/s]", "v_y, to the left [m/s]", "yaw rate, to the left [rad/s]")
VELOCITY_RANGE = 1.6  # of the plots' scale, which grows with larger velocities [m/s, rad/s]
TORQUE, ANGLE = "{} torque, {:.3g} to {:.3g} N m", "{} angle, {:.2f} to {:.2f} rad"  # with limits
STRIDE = 2  # control steps per point of a plot
GAIT_STEPS = HISTORY_STEPS // 2  # control steps in the gait diagram
MEAN_STEPS = 15  # control steps over which present reward terms are means: 0.3 s
SUM = "sum of all"  # of the reward terms
WIDTH = 300  # of the panel [pixels]


class Plots:
    """The panel with plots."""

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        """Build the panel at the left of the page."""
        task, self._session = session.task, session
        self._joints = [name.removesuffix("_joint").replace("_", " ") for name in task.dof_names]
        self._legs = joints_by_leg(task.dof_names, task.cfg.asset.mirrored_legs)
        self._torque_limits = task.torque_limits.cpu().numpy()
        self._angle_limits = joint_limits(task.sim.mj_model)[1:].T
        feet = [task.asset.foot_names[task.asset.foot_of.index(foot)] for foot in dict.fromkeys(task.asset.foot_of)]
        words = [name.split("_")[0] for name in feet]  # a foot may have several geoms, of which this names one
        self._feet, self._terms = words if len(set(words)) == len(words) else feet, task.reward_names
        self._parts = list(zip((name.replace("_", " ") for name in session.mixing), cycle(PARTS), strict=False))
        self._has_targets = any(term.name == PD_CONTROL for term in task.control_law.terms)
        seconds, panel = HISTORY_STEPS * task.dt, gui.add_panel()
        with panel.add_tab("Walking", viser.Icon.ACTIVITY):
            self._lines = [("commanded", COMMAND), ("actual", ACTUAL), ("companion", COMPANION)]
            self._lines = self._lines if session.companion else self._lines[:2]
            self._now = gui.add_html("")
            self._velocities = add_plots(gui, seconds, VELOCITIES, self._lines, VELOCITY_RANGE)
            self._metrics, self._gait, self._bars = gui.add_html(""), gui.add_html(""), gui.add_html("")
        with panel.add_tab("Joints", viser.Icon.ROBOT):
            self._leg = gui.add_dropdown("leg", tuple(self._legs), hint="whose joints are plotted")
            titles = [""] * max(map(len, self._legs.values()))
            lines = [*self._parts, ("applied", APPLIED)]
            gui.add_html(block_html(legend_html([*lines, ("limits", LIMIT)]), []))
            self._torques = add_plots(gui, seconds, titles, lines, has_limits=True)
            lines = [("target", COMMAND), ("position", ACTUAL)][0 if self._has_targets else 1 :]
            gui.add_html(block_html(legend_html([*lines, ("limits", LIMIT)]), []))
            self._angles = add_plots(gui, seconds, titles, lines, has_limits=True)
        with panel.add_tab("Rewards", viser.Icon.TROPHY):
            self._term = gui.add_dropdown("over time", (SUM, *self._terms), hint="what is plotted")
            self._reward = add_plots(gui, seconds, ["weighted, per second"], [("term", ACTUAL)])
            self._rewards = gui.add_html("")
        panel.dock_left()
        panel.set_width(WIDTH)

    def update(self) -> None:
        """Draw everything."""
        past, dt = list(self._session.history), self._session.task.dt
        if len(past) < 2 * STRIDE:
            return
        feet = np.array([one.feet for one in past[-GAIT_STEPS:]])
        self._gait.content = gait_html(self._feet, feet, GAIT_STEPS, round(GAIT_STEPS * dt, 1))
        self._bars.content = self._torque_bars(past[-1].torques, past[-1].torque_parts)
        self._metrics.content = self._metrics_table(past)
        self._rewards.content = self._reward_bars(np.mean([one.rewards for one in past[-MEAN_STEPS:]], axis=0))
        now, past = past[-1].time, past[len(past) % STRIDE :: STRIDE]  # always the same steps, against jitter
        time = np.array([one.time for one in past]) - now
        velocities = [[one.commands[one.world] for one in past], [one.velocities[one.world] for one in past]]
        if other := self._session.companion:
            known = {round(one.time, 4): one.velocities[0] for one in list(other.history)}
            velocities.append([known.get(round(one.time, 4), np.full(3, np.nan)) for one in past])
        draw(self._velocities, time, velocities)
        means = np.mean(np.array(velocities)[:, -MEAN_STEPS // STRIDE :], axis=1)
        rows = [(*line, [f"{value:+.2f}" for value in mean]) for line, mean in zip(self._lines, means, strict=True)]
        self._now.content = table_html(("", "", ["v_x", "v_y", "yaw rate"]), *rows)
        torques = np.array([[*one.torque_parts, one.torques] for one in past])
        self._draw_leg(self._torques, TORQUE, time, torques.swapaxes(0, 1), self._torque_limits)
        targets = [[one.targets for one in past]] if self._has_targets else []
        angles = [*targets, [one.qpos[one.world, 7:] for one in past]]
        self._draw_leg(self._angles, ANGLE, time, angles, self._angle_limits)
        rewards = np.array([one.rewards for one in past])
        shown = rewards.sum(axis=1) if self._term.value == SUM else rewards[:, self._terms.index(self._term.value)]
        draw(self._reward, time, [shown[:, None]])

    def _metrics_table(self, past: list[Snapshot]) -> str:
        """Return metrics over the history, as evaluate.py measures them."""
        other, rows = self._session.companion, list[Row]()
        histories = [past, *([list(other.history)] if other else [])]
        for name in past[0].metrics:
            sums = [sum((one.metrics.get(name, np.zeros(2)) for one in past), np.zeros(2)) for past in histories]
            texts = [f"{above / below:.3g}" if below else "-" for above, below in sums]
            rows.append((f"{name.replace('_', ' ')} {UNITS[name] and f'[{UNITS[name]}]'}", "", texts))
        head = f"<b>Metrics, last {HISTORY_STEPS * self._session.task.dt:g} s</b>"
        return table_html((head, "", ["actual", "companion"][: len(histories)]), *rows)

    def _draw_leg(
        self, plots: Sequence[viser.GuiUplotHandle], title: str, time: np.ndarray, values: ArrayLike, limits: np.ndarray
    ) -> None:
        """Draw curves of the chosen leg's joints over time and their limits, given those of all joints.

        Shapes: (steps,), (series, steps, num_dof), (2, num_dof).
        """
        chosen = self._legs[self._leg.value]
        for i, plot in enumerate(plots):
            plot.visible = i < len(chosen)
            if plot.visible:
                plot.title = title.format(self._joints[chosen[i]], *limits[:, chosen[i]])
        lines = np.where(np.isfinite(limits), limits, np.nan)[:, None].repeat(len(time), axis=1)
        draw(plots, time, np.concatenate([values, lines])[:, :, chosen])

    def _torque_bars(self, torques: np.ndarray, parts: np.ndarray) -> str:
        """Return the present torques as bars, in parts if the task mixes action terms."""
        colors = [color for _, color in self._parts] or [ACTUAL]
        parts = parts if self._parts else torques[None]
        rows, limits = [], np.abs(self._torque_limits).max(axis=0)
        for name, values, torque, limit in zip(self._joints, parts.T, torques, limits, strict=True):
            rows.append(bars_html(name, values / limit, colors, f"{torque:+.1f}/{limit:.0f}"))
        weights = zip(self._parts, self._session.mixing.values(), strict=True)
        legend = legend_html((f"{name} x {weight:.2f}", color) for (name, color), weight in weights)
        return block_html(f"<b>Torques and their limits [N m]</b>{legend}", rows)

    def _reward_bars(self, rewards: np.ndarray) -> str:
        """Return weighted reward terms as bars, rewards in green and penalties in red. Shape: (terms,)."""
        largest, rows = max(np.abs(rewards).max(initial=0.0), 1e-9), []
        for name, value in zip(self._terms, rewards, strict=True):
            color = REWARD if value > 0 else PENALTY
            rows.append(bars_html(name.replace("_", " "), [value / largest], [color], f"{value:+.3f}", "lt-wide"))
        return block_html(f"<b>Weighted terms [1/s]; their sum: {rewards.sum():+.3f}</b>", rows)


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
    series: Sequence[tuple[str, str]],
    reach: float = 0.0,
    has_limits: bool = False,
) -> list[viser.GuiUplotHandle]:
    """Add plots of equal series over the last seconds, and of two limits where the data come near them.

    The scale holds at least the values from -reach to reach.
    """
    lines = [{"label": name, "stroke": color, "width": 1.5, "points": {"show": False}} for name, color in series]
    limit = {"label": "limit", "stroke": LIMIT, "width": 1, "dash": (4, 4), "auto": False, "points": {"show": False}}
    lines += 2 * [limit] if has_limits else []
    soft = {"mode": int(reach > 0.0), "pad": 0.1}
    ends = {"min": {"soft": -reach, **soft}, "max": {"soft": reach, **soft}}
    font = {"font": "10px sans-serif", "labelFont": "10px sans-serif"}
    settings = {
        "scales": {"x": {"time": False, "auto": False, "range": (-seconds, 0)}, "y": {"auto": True, "range": ends}},
        "axes": ({"size": 28, "label": "time [s]", "labelSize": 12, **font}, {"size": 38, **font}),
        "legend": {"show": False},
        "height": 140,  # [pixels]
    }
    nothing = (np.zeros(2),) * (len(lines) + 1)
    return [gui.add_uplot(nothing, ({"label": "s"}, *lines), title=title, **settings) for title in titles]


def draw(plots: Sequence[viser.GuiUplotHandle], time: np.ndarray, curves: ArrayLike) -> None:
    """Draw curves over time, a plot per item of the last axis. Shapes: (steps,), (series, steps, plots)."""
    for plot, series in zip(plots, np.moveaxis(np.array(curves), 2, 0), strict=False):
        plot.data = (time, *series)


def gait_html(names: Sequence[str], contacts: np.ndarray, steps: int, seconds: float) -> str:
    """Return a gait diagram of some steps with a row per foot, dark while it is on the ground, and their share.

    Contacts are 1 on the ground, else 0; the last one is now. Shape: (at most ``steps``, feet).
    """
    rows = []
    for name, column in zip(names, contacts.T > 0, strict=True):
        changes = np.flatnonzero(np.diff(column.astype(int), prepend=0, append=0)) + steps - len(column)
        path = "".join(f"M{begin} 0V1H{end}V0z" for begin, end in changes.reshape(-1, 2))
        rows.append(row_html(name, f"0 0 {steps} 1", [(path, STANCE)], f"{100 * column.mean():.0f} %"))
    return block_html(f"<b>Feet on the ground, last {seconds:g} s</b>", rows)


def legend_html(series: Series) -> str:
    """Return names with colored dots."""
    dots = (f'<span><span style="color:{color}">&#9679;</span> {name}</span>' for name, color in series)
    return f'<div class="lt-legend">{"".join(dots)}</div>'


def table_html(*rows: Row) -> str:
    """Return a table, whose first row is its head."""
    lines = []
    for name, color, texts in rows:
        dot = f'<span style="color:{color}">&#9679;</span> ' if color else ""
        lines.append(f"<tr><td>{dot}{name}</td>{''.join(f'<td>{text}</td>' for text in texts)}</tr>")
    return f'<table class="lt-plot">{"".join(lines)}</table>'


def block_html(title: str, rows: list[str]) -> str:
    """Return rows below a title."""
    return f'<div class="lt-plot">{title}{"".join(rows)}</div>'


def bars_html(name: str, lengths: Iterable[float], colors: Sequence[str], text: str, kind: str = "") -> str:
    """Return a row of bars from its middle, with lengths from -1 to 1, between a name and a text."""
    bars = enumerate(zip(lengths, colors, strict=True))
    shapes = [(f"M0 {i}V{i + 1}H{np.clip(length, -1, 1):.3f}V{i}z", color) for i, (length, color) in bars]
    middle = (f"M-.004 0V{len(colors)}H.004V0z", MIDDLE)
    return row_html(name, f"-1 0 2 {len(colors)}", [*shapes, middle], text, kind)


def row_html(name: str, view: str, shapes: Series, text: str, kind: str = "") -> str:
    """Return a row with an SVG of paths and colors in a view box, between a name and a text."""
    paths = "".join(f'<path d="{path}" fill="{color}"/>' for path, color in shapes)
    svg = f'<svg viewBox="{view}" preserveAspectRatio="none">{paths}</svg>'
    return f'<div class="lt-row {kind}"><span>{html.escape(name)}</span>{svg}<span>{text}</span></div>'
