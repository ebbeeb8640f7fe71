"""Pictures of what a task draws at random, against what its settings say."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from legged_torque.envs.base import domain_rand
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.sim.randomization import Parameter, per_column
from legged_torque.utils.plotting import load_pyplot, save_figure

GROUPS = ("initial state", "robot", "ground", "controller", "other", "events", "sensors")
COLORS = dict(zip(GROUPS, ("#56B4E9", "#E69F00", "#009E73", "#CC79A7", "#0072B2", "#F0E442", "#999999"), strict=True))
OWN = "#D55E00"  # all can be told apart by colour-blind people
COLUMNS, BINS = 6, 20
STEPS = 1000  # control steps over which events are watched
UNITS = {
    "rad": ("roll", "pitch", "yaw", "joint_offset", "action_scale"),
    "rad/s": ("init_ang_vel", "init_dof_vel"),
    "m": ("init_place", "trunk_com", "foot_radius", "foot_offset"),
    "m/s": ("init_lin_vel",),
    "m/s²": ("gravity",),
    "kg": ("trunk_mass",),
    "kg m²": ("trunk_inertia", "dof_armature"),
    "N m": ("torque_scale", "dof_frictionloss"),
    "N m/rad": ("p_gains", "dof_stiffness"),
    "N m s/rad": ("d_gains", "dof_damping"),
    "1/s": ("contact_damping",),
    "1/s²": ("contact_stiffness",),
}
UNIT_OF = {name: f" [{unit}]" for unit, names in UNITS.items() for name in names}


Numbers: TypeAlias = Any  # a list or an array of numpy


@dataclass
class Panel:
    """Numbers that were drawn, and how they should be distributed: U(offset) x U(scale) x U(column_scale)."""

    group: str  # one of GROUPS
    title: str  # with its unit
    values: Any  # a row per world: a tensor when it is made, then an array of numpy
    offset: Numbers  # range, including what the offset is added to
    scale: Numbers = (1.0, 1.0)  # range
    column_scale: Numbers = (1.0, 1.0)  # range
    own: Numbers = (0.0,)  # values without draws, one per column
    may_keep: bool = False  # whether some worlds keep their own values
    bins: int = BINS
    geometric: float = 0.0  # probability of a geometric distribution in place of the uniform ones

    def __post_init__(self) -> None:
        """Copy the numbers, because the task changes them later."""
        self.values = self.values.unsqueeze(-1).flatten(1).cpu().double().numpy().copy()

    def limits(self) -> tuple[float, float]:
        """Return the lowest and the highest number that can be drawn."""
        ends = np.multiply.outer(np.outer(self.offset, self.scale), self.column_scale)
        return ends.min(), ends.max()

    def density(self, at: np.ndarray) -> np.ndarray:
        """Return the expected density."""
        if self.geometric:
            return self.geometric * (1.0 - self.geometric) ** (at - 1.0)
        ranges = [self.offset, self.scale, self.column_scale]
        first = next(i for i, ends in enumerate(ranges) if ends[0] < ends[1])
        low, high = ranges.pop(first)  # the density of a product is a mean over the other factors
        factor = np.outer(*(np.linspace(ends[0], ends[1], 81 if ends[0] < ends[1] else 1) for ends in ranges)).reshape(
            -1, 1
        )
        inside = (at / factor >= low) & (at / factor <= high)
        return (inside / factor).mean(axis=0) / (high - low)


def draw_distributions(task: LeggedRobot, fixed: LeggedRobot, file: Path) -> None:
    """Draw a panel per random number of a task into a new file; ``fixed`` is the task without random parameters."""
    panels = [*parameters(task, fixed), *sensors(task), *events(task)]  # events change the task, so come last
    draw(sorted(panels, key=lambda panel: GROUPS.index(panel.group)), file)


def parameters(task: LeggedRobot, fixed: LeggedRobot) -> list[Panel]:
    """Return the panels of initial state, robot, ground and controller; ``fixed`` has no random parameters."""
    panels = [action_delay(task)]
    for drawn in domain_rand.initial_state(task):
        if drawn.name == "init_place":
            drawn = replace(drawn, field=from_origins(task))
        if drawn.name not in ("base_height", "action_delay"):  # never random, and a whole number
            panels.append(panel_of(drawn, "initial state", per_column(drawn.base or 0.0, len(drawn.columns))))
    readers = (domain_rand.robot_parameters, domain_rand.ground_parameters, domain_rand.control_parameters)
    group_of = {drawn.name: group for group, read in zip(GROUPS[1:], readers, strict=False) for drawn in read(task)}
    for drawn, own in zip(task.random_parameters(), fixed.random_parameters(), strict=True):
        if not task.cfg.domain_rand.randomize_parameters:
            drawn = Parameter(own.name, own.field, own.columns, shared=own.shared)
        panels.append(panel_of(drawn, group_of.get(own.name, "other"), own.field[0, list(own.columns)].tolist()))
    return panels


def from_origins(task: LeggedRobot) -> torch.Tensor:
    """Return where trunks are, from where the episodes of their worlds start [m]. Shape: (num_envs, 3)."""
    origins = torch.zeros_like(task.base_pos)
    task.terrain.move_to_origin(torch.ones_like(task.reset_buf), origins)
    return task.base_pos - origins


def action_delay(task: LeggedRobot) -> Panel:
    """Return the panel of the delay, which is a whole number."""
    low, high = task.cfg.domain_rand.action_delay
    ends = (low - 0.5, high + 0.5) if high > low else (low, low)
    title = f"action delay [{task.cfg.domain_rand.action_delay_unit.replace('_', ' ')}]"
    return Panel("initial state", title, task.action_delay.drawn.floor(), ends, bins=high - low + 1)


def panel_of(drawn: Parameter, group: str, own: Numbers) -> Panel:
    """Return the panel of a parameter: of its first column if all columns share a draw.

    Numbers that replace the own values are shown over their weight. If columns have different own values, the
    differences to these are shown, or the ratios if a factor is drawn.
    """
    columns = list(drawn.columns)[: drawn.num_listed]
    own = np.array(own[: len(columns)])
    base = own if drawn.base is None else np.array(per_column(drawn.base, len(drawn.columns)))[: len(columns)]
    weight = per_column(drawn.weight, len(drawn.columns))[0]
    title, unit, shift = drawn.name.replace("_", " "), UNIT_OF.get(drawn.name, ""), 0.0 * own
    factor: Numbers = 1.0
    if not base.any():
        factor = weight
    elif np.ptp(base) > 0.0 and drawn.scale == (1.0, 1.0):
        title, shift = f"{title} - own", base
    elif np.ptp(base) > 0.0:
        title, unit, factor = f"{title} / own", "", base

    def shown(values: np.ndarray) -> np.ndarray:
        return (values - shift) / factor

    values = torch.as_tensor(shown(drawn.field[:, columns].cpu().numpy()))
    offset = [shown(base + weight * end)[0] for end in drawn.offset]
    factors = (drawn.scale, drawn.column_scale or (1.0, 1.0))
    return Panel(group, title + unit, values, offset, *factors, shown(own), drawn.may_keep)


def sensors(task: LeggedRobot) -> list[Panel]:
    """Return the panels of the errors of noisy observations, in the units of the sensors."""
    observations, groups = task.observations, task.get_observations()
    panels = []
    for term in observations.policy_terms():
        if term.noise:
            newest = observations.policy_columns(term.name)[: observations.sizes[term.name]]
            scale = torch.as_tensor(term.scale, device=task.device)
            error = (groups["policy"][:, newest] - groups["critic"][:, newest]) / scale
            largest = term.noise * task.cfg.noise.add_noise
            unit = f" [{term.unit}]" if term.unit else ""
            panels.append(Panel("sensors", f"{term.name.replace('_', ' ')} error{unit}", error, (-largest, largest)))
    return panels


def events(task: LeggedRobot) -> list[Panel]:
    """Return the panels of pushes and redraws, from steps without physics in which trunks start at rest."""
    rand, velocity, numbers = task.cfg.domain_rand, task.sim.qvel[:, :3], task.randomization.values
    start, first, pushes = numbers.clone(), torch.full((task.num_envs,), torch.inf, device=task.device), []
    nowhere = torch.zeros_like(task.reset_buf)
    rand.push_set_factor = 1.0  # what is drawn, before it
    for step in range(1, STEPS + 1):
        velocity.zero_()
        task.events.happen(nowhere)
        first.clamp_(max=torch.where((numbers != start).any(dim=1), step, torch.inf))
        pushes.append(velocity[(velocity != 0.0).any(dim=1)])
    chance = rand.resampling_probability * rand.randomize_parameters
    until, push = np.multiply([1.0, STEPS], chance > 0.0), np.multiply(rand.push_velocity, rand.push_robots)
    return [
        Panel("events", "push as drawn, per axis [m/s]", torch.cat(pushes), push),
        Panel("events", "steps to the next redraw", first, until, own=(), geometric=chance),
    ]


def draw(panels: list[Panel], file: Path) -> None:
    """Draw all panels into a picture."""
    pyplot = load_pyplot()
    rows = -(-len(panels) // COLUMNS)
    pyplot.rcParams.update({"font.size": 9, "axes.titlesize": 9})
    figure, axes = pyplot.subplots(rows, COLUMNS, figsize=(2.05 * COLUMNS, 1.6 * rows + 0.6), layout="constrained")
    for axis, panel in zip(axes.flat, panels + [None] * (axes.size - len(panels)), strict=True):
        draw_panel(axis, panel) if panel else axis.set_axis_off()
    figure.get_layout_engine().set(w_pad=0.09)
    groups = list(dict.fromkeys(panel.group for panel in panels))
    handles = [pyplot.Rectangle((0, 0), 1, 1, color=COLORS[group]) for group in groups]
    handles += [pyplot.Line2D([], [], color="black"), pyplot.Line2D([], [], color=OWN, linestyle="--")]
    labels = [*groups, "expected", "without draws"]
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    save_figure(figure, file)


def draw_panel(axis, panel: Panel) -> None:
    """Draw the expected density, the own values, and a histogram of the worlds that do not keep these."""
    axis.set(title=panel.title, yticks=[])
    axis.spines[["left", "right", "top"]].set_visible(False)
    for own in np.unique(panel.own):
        axis.axvline(own, color=OWN, linestyle="--", linewidth=1.2)
    label = partial(axis.text, 0.5, transform=axis.transAxes, ha="center", backgroundcolor="white")
    low, high = panel.limits()
    if low == high:
        label(0.5, "not drawn")
        axis.set(xticks=[low], xlim=(low - 1.0, low + 1.0))
        return
    kept = (panel.values == np.float32(panel.own)).all(axis=1) & panel.may_keep
    if kept.any():
        label(0.88, f"{kept.mean():.0%} keep their own")
    bars, edges = np.histogram(panel.values[~kept], panel.bins, (low, high))
    axis.stairs(bars / max(1, panel.values[~kept].size) / np.diff(edges), edges, fill=True, color=COLORS[panel.group])
    at = np.linspace(low, high, 400)
    axis.plot([low, *at, high], [0.0, *panel.density(at), 0.0], color="black", linewidth=1.0)
    axis.set_ylim(0.0, 1.35 * panel.density(at).max())
