"""A picture of the random numbers of a task, against the distributions that its settings ask for."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legged_torque.envs import task_registry
from legged_torque.paper.plotting import load_pyplot, save_figure
from legged_torque.utils import cli
from legged_torque.utils.task_registry import set_seed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from legged_torque.envs.base.legged_robot import LeggedRobot
    from legged_torque.sim.randomization import Randomization

COLORS = {"reset": "#56B4E9", "model": "#E69F00", "control": "#CC79A7", "push": "#F0E442", "sensor": "#999999"}
"""By group of numbers; colour-blind people can distinguish them."""
OWN = "#D55E00"
COLUMNS, BINS = 6, 20
SAMPLES = 200_000  # of an expected distribution
_RNG = np.random.default_rng(0)
STEPS = 1000  # control steps in which pushes are counted


@dataclass
class Panel:
    """Numbers that were drawn, and samples of their expected distribution."""

    group: str  # a key of COLORS
    title: str  # with its unit
    values: np.ndarray  # Shape: (any,)
    expected: np.ndarray  # Shape: (any,)
    own: float = 0.0  # value without draws
    may_keep: bool = False  # whether some worlds keep their own values


def plot_randomization() -> None:
    """Read the command line, build a task, and draw a panel per random parameter."""
    parser = cli.Parser(
        "Draw the random numbers of a task: ``python scripts/plot.py randomization --out distributions.png``.\n\n"
        "Builds 2000 worlds of a1_position with --perturbation low, by default, and reads the numbers that physics and "
        "controller use, in the units of the simulation. Of several joints, the first one is shown."
    )
    cli.add_options(parser, *cli.SETTINGS, "num_envs")
    parser.set_defaults(task="a1_position", perturbation="low", num_envs=2000)
    parser.add_argument("--out", type=Path, required=True, help="picture to write (png, svg, pdf)")
    args = parser.parse_args()
    cli.check_output(args.out)
    options = cli.options_of(args)
    with cli.slow_imports():
        env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
        from legged_torque.envs.base.legged_robot import LeggedRobot
    set_seed(train_cfg.seed)
    fixed_cfg = copy.deepcopy(env_cfg)
    fixed_cfg.env.num_envs, fixed_cfg.domain_rand.randomize_parameters = 1, False
    fixed, task = (task_registry.make_env(options.task, options, cfg)[0] for cfg in (fixed_cfg, env_cfg))
    assert isinstance(task, LeggedRobot)
    assert isinstance(fixed, LeggedRobot)
    draw(panels(task, fixed), args.out)


def panels(task: LeggedRobot, fixed: LeggedRobot) -> list[Panel]:
    """Return a panel per random number of a task; ``fixed`` is one world of it without random parameters."""
    is_drawn = bool(task.cfg.domain_rand.randomize_parameters)
    parameters = random_parameters(task.randomization, fixed.randomization, is_drawn)
    return [*initial_state(task), *parameters, *sensors(task), pushes(task)]  # pushes change the task


def initial_state(task: LeggedRobot) -> list[Panel]:
    """Return the panels of states in which episodes start, on rough ground from the middle of a tile."""
    import torch

    origins = torch.zeros_like(task.base_pos)
    task.terrain.move_to_origin(torch.ones_like(task.reset_buf), origins)
    result = random_parameters(task.events.initial_state, task.events.initial_state, True, "reset")
    for panel in result:
        if panel.title.startswith("init place"):
            panel.values -= origins[:, 0].cpu().numpy()
        elif panel.title.startswith("action delay"):  # its whole part counts
            panel.values, panel.expected = np.floor(panel.values), np.floor(panel.expected)
    return result


def random_parameters(drawn: Randomization, fixed: Randomization, is_drawn: bool, group: str = "") -> list[Panel]:
    """Return a panel for each parameter with a range, of its first number; ``fixed`` has their own values."""
    from legged_torque.sim.randomization import table

    result = []
    for parameter, before in zip(drawn.parameters, fixed.parameters, strict=True):
        is_of_model = isinstance(parameter.field, str)
        name = str(parameter.field) if is_of_model else parameter.name
        row = table(before, fixed.fields[name], 0.0)[0]
        own = row.base if group else row.own_value
        expected = row.base + row.weight * uniform(row.offset_low, row.offset_span)
        expected *= uniform(row.scale_low, row.scale_span) * uniform(row.column_low, row.column_span)
        expected = expected.clip(row.lowest, row.highest) if is_drawn else np.array([own])
        values = drawn.fields[name][:, parameter.columns[0]].double().cpu().numpy().copy()
        title = parameter.name.replace("_", " ") + (f" [{parameter.unit}]" if parameter.unit else "")
        if parameter.draw:
            place = group or ("model" if is_of_model else "control")
            result.append(Panel(place, title, values, expected, own, parameter.may_keep))
    return result


def uniform(low: float, span: float) -> np.ndarray:
    """Return samples of a uniform distribution."""
    return _RNG.uniform(low, low + span, SAMPLES)


def sensors(task: LeggedRobot) -> list[Panel]:
    """Return the panels of the errors of noisy observations, in the units of the sensors."""
    observations, groups = task.observations, task.get_observations()
    result = []
    for term in observations.policy_terms():
        if term.noise:
            column = observations.policy_columns(term.name)[0]
            scale = term.scale if isinstance(term.scale, (int, float)) else term.scale[0]
            error = (groups["policy"][:, column] - groups["critic"][:, column]).double().cpu().numpy() / scale
            largest = term.noise * task.cfg.noise.add_noise
            unit = f" [{term.unit}]" if term.unit else ""
            title = f"{term.name.replace('_', ' ')} error{unit}"
            result.append(Panel("sensor", title, error, uniform(-largest, 2 * largest)))
    return result


def pushes(task: LeggedRobot) -> Panel:
    """Return the panel of pushes, from steps without physics in which trunks start at rest."""
    import torch

    rand, velocity, pushed = task.cfg.domain_rand, task.sim.qvel[:, :3], []
    rand.push_set_factor = 1.0
    for _ in range(STEPS):
        velocity.zero_()
        task.events.apply(torch.zeros_like(task.reset_buf))
        pushed.append(velocity[(velocity != 0.0).any(dim=1)].flatten())
    low, high = np.multiply(rand.push_velocity, rand.push_robots)
    values = torch.cat(pushed).double().cpu().numpy()
    return Panel("push", "push as drawn, per axis [m/s]", values, uniform(low, high - low))


def draw(shown: Sequence[Panel], file: Path) -> None:
    """Draw all panels into a picture."""
    pyplot = load_pyplot()
    rows = -(-len(shown) // COLUMNS)
    pyplot.rcParams.update({"font.size": 9, "axes.titlesize": 9})
    figure, axes = pyplot.subplots(rows, COLUMNS, figsize=(2.05 * COLUMNS, 1.6 * rows + 0.6), layout="constrained")
    for axis in axes.flat[len(shown) :]:
        axis.set_axis_off()
    for axis, panel in zip(axes.flat, shown, strict=False):
        draw_panel(axis, panel)
    figure.get_layout_engine().set(w_pad=0.09)
    handles = [pyplot.Rectangle((0, 0), 1, 1, color=color) for color in COLORS.values()]
    handles += [pyplot.Line2D([], [], color="black"), pyplot.Line2D([], [], color=OWN, linestyle="--")]
    labels = [*COLORS, "expected", "without draws"]
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    save_figure(figure, file)


def draw_panel(axis: Axes, panel: Panel) -> None:
    """Draw the expected density, the own value, and a histogram of the worlds that do not keep it."""
    axis.set(title=panel.title, yticks=[])
    axis.spines[["left", "right", "top"]].set_visible(False)
    axis.axvline(panel.own, color=OWN, linestyle="--", linewidth=1.2)
    place: dict[str, Any] = {"transform": axis.transAxes, "ha": "center", "backgroundcolor": "white"}
    if np.ptp(panel.expected) == 0.0:
        axis.text(0.5, 0.5, "not drawn", **place)
        return
    kept = panel.may_keep & (panel.values == np.float32(panel.own))
    if kept.any():
        axis.text(0.5, 0.88, f"{kept.mean():.0%} keep their own", **place)
    limits = (panel.expected.min(), panel.expected.max())
    looks: list[dict[str, Any]] = [{"fill": True, "color": COLORS[panel.group]}, {"color": "k"}]
    for values, how in zip((panel.values[~kept], panel.expected), looks, strict=True):
        counts, edges = np.histogram(values, BINS, limits)
        axis.stairs(counts / len(values), edges, **how)
