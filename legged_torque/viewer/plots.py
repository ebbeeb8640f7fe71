"""The plots of the page: velocities, gait, joints and reward terms of the followed world."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser

from legged_torque.viewer.bars import block_html, gait_html, legend_html, reward_bars, row_html
from legged_torque.viewer.reading import Reading
from legged_torque.viewer.session import HISTORY_STEPS, Session
from legged_torque.viewer.state import SessionState

COMMAND, ACTUAL, APPLIED = "#1faa55", "#2f7df6", "#343a40"
BESIDE = "#f08c00"
PARTS = ("#f08c00", "#2f7df6", "#ae3ec9", "#1faa55")  # colors of the parts of torques
VELOCITIES = ("v_x, forward [m/s]", "v_y, to the left [m/s]", "yaw rate, to the left [rad/s]")
STRIDE = 2  # plots show every second control step
WIDTH = 300  # of the panel [pixels]
GAIT_SECONDS = 5  # that the gait diagram shows
SUM = "sum of all"  # the reward terms together


class Plots:
    """The panel with plots."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        """Build the panel, at the left of the page."""
        gui, task, self._session = server.gui, session.task, session
        self._joints = [name.removesuffix("_joint") for name in task.dof_names]
        self._legs = joints_by_leg(self._joints, task.cfg.asset.mirrored_legs)
        self._limits = task.torque_limits.abs().amax(dim=0).tolist()
        self._feet = [name.removesuffix("_foot") for name in task.foot_names]
        self._terms = task.reward_names
        parts = [name.replace("_", " ") for name in session.state.mixing]
        self._has_targets = any(term.name == "position_residual" for term in task.control_law.terms)
        self._parts = [(name, PARTS[i % len(PARTS)]) for i, name in enumerate(parts)]
        panel = gui.add_panel()
        with panel.add_tab("Walking", viser.Icon.ACTIVITY):
            legend = [("commanded", COMMAND), ("actual", ACTUAL)] + [("beside", BESIDE)] * bool(session.companion)
            gui.add_html(legend_html(legend))
            self._velocities = [add_plot(gui, title, legend, (-1.6, 1.6)) for title in VELOCITIES]
            self._gait, self._bars = gui.add_html(""), gui.add_html("")
        with panel.add_tab("Joints", viser.Icon.ROBOT):
            self._leg = gui.add_dropdown("leg", tuple(self._legs))
            series = [*self._parts, ("applied", APPLIED)]
            angles = [("target", COMMAND), ("position", ACTUAL)] if self._has_targets else [("position", ACTUAL)]
            most = max(len(joints) for joints in self._legs.values())
            gui.add_html(legend_html(series))
            self._torques = [add_plot(gui, "torque", series) for _ in range(most)]
            gui.add_html(legend_html(angles))
            self._angles = [add_plot(gui, "position", angles) for _ in range(most)]
            self._leg.on_update(lambda event: self._choose_leg())
            self._choose_leg()
        with panel.add_tab("Rewards", viser.Icon.TROPHY):
            self._term = gui.add_dropdown("over time", (SUM, *self._terms))
            self._term_plot = add_plot(gui, "weighted, per second", [("term", ACTUAL)])
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
        for what, plots in (("torque of {} [N m]", self._torques), ("angle of {} [rad]", self._angles)):
            for i, plot in enumerate(plots):
                plot.visible = i < len(self._chosen)
                if plot.visible:
                    plot.title = what.format(self._joints[self._chosen[i]].replace("_", " "))

    def _update_curves(self, now: float) -> None:
        """Draw the last seconds before a simulated time [s]."""
        past = list(self._session.history)
        feet = np.array([reading.feet for reading in past[-50 * GAIT_SECONDS :]])
        past = past[len(past) % STRIDE :: STRIDE]  # the same steps every time, so that curves do not jitter
        if len(past) < 2:
            return
        time = np.array([reading.time - now for reading in past], np.float32)
        velocities = np.array([(one.commands[one.world], one.velocities[one.world]) for one in past])
        beside = [self._velocities_beside(past)] if self._session.companion else []
        for i, plot in enumerate(self._velocities):
            plot.data = (time, *velocities[:, :, i].T, *(values[:, i] for values in beside))
        self._gait.content = gait_html(self._feet, feet, GAIT_SECONDS)
        torques = np.array([[*reading.torque_parts, reading.torques] for reading in past])
        for plot, joint in zip(self._torques, self._chosen, strict=False):
            plot.data = (time, *torques[:, :, joint].T)
        targets = [[reading.targets] if self._has_targets else [] for reading in past]
        joints = [reading.qpos[reading.world, -len(self._joints) :] for reading in past]
        angles = np.array([[*target, position] for target, position in zip(targets, joints, strict=True)])
        for plot, joint in zip(self._angles, self._chosen, strict=False):
            plot.data = (time, *angles[:, :, joint].T)
        rewards = np.array([reading.rewards for reading in past])
        chosen = self._term.value
        self._term_plot.data = (time, rewards.sum(axis=1) if chosen == SUM else rewards[:, self._terms.index(chosen)])

    def _velocities_beside(self, past: Sequence[Reading]) -> np.ndarray:
        """Return the velocities of the companion's robot at the times of some steps; NaN where it has none."""
        assert self._session.companion
        known = {round(reading.time, 4): reading.velocities[0] for reading in list(self._session.companion.history)}
        return np.array([known.get(round(reading.time, 4), np.full(3, np.nan)) for reading in past])

    def _torque_bars(self, reading: Reading, mixing: dict[str, float]) -> str:
        """Return all torques of this moment as bars, in parts if the task mixes action terms."""
        rows = []
        for i, name in enumerate(self._joints):
            colors = [color for _, color in self._parts] or [ACTUAL]
            values = reading.torque_parts[:, i] if self._parts else reading.torques[i : i + 1]
            bars = [(value / self._limits[i], color) for value, color in zip(values, colors, strict=True)]
            rows.append(row_html(name.replace("_", " "), bars, f"{reading.torques[i]:+.1f}/{self._limits[i]:.0f}"))
        title = "Torques of their limits [N m]"
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
