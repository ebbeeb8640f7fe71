"""Draw what a task draws at random: ``python scripts/plot_randomization.py --out distributions.png``.

Builds 2000 worlds of a1_position with --perturbation low, unless told otherwise, and reads their numbers where physics
and controller read them.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from legged_torque.utils.rendering import without_renderer

without_renderer()  # before anything imports mujoco

import numpy as np
import torch

from legged_torque.envs import task_registry
from legged_torque.envs.base.domain_rand import TRUNK
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.utils.args import Parser, add_build_args, options_of
from legged_torque.utils.cli import run_script
from legged_torque.utils.plotting import load_pyplot, save_figure
from legged_torque.utils.task_registry import set_seed

GROUPS = ("initial state", "robot", "ground", "controller", "events", "sensors")
COLORS = dict(zip(GROUPS, ("#56B4E9", "#E69F00", "#009E73", "#CC79A7", "#F0E442", "#999999"), strict=True))
OWN = "#D55E00"  # all are told apart by colour-blind eyes
COLUMNS, BINS = 6, 20
STEPS = 1000  # control steps over which events are watched


@dataclass
class Panel:
    """Numbers that were drawn, and how they should be distributed: U(offset) x U(scale)."""

    group: str
    title: str  # with its unit
    values: torch.Tensor  # a row per world
    offset: tuple[float, float]  # range, with what the offset is added to
    scale: tuple[float, float] = (1.0, 1.0)
    own: np.ndarray | float = 0.0  # without draws: one number, or as many as a world has
    bins: int = BINS
    geometric: float = 0.0  # probability of a geometric distribution, in place of the uniform ones

    def __post_init__(self) -> None:
        """Copy the numbers, which the task goes on to change."""
        self.values = self.values.unsqueeze(-1).flatten(1).cpu().double().numpy().copy()

    def limits(self) -> tuple[float, float]:
        """Return the lowest and the highest number that can be drawn."""
        return np.outer(self.offset, self.scale).min(), np.outer(self.offset, self.scale).max()

    def density(self, at: np.ndarray) -> np.ndarray:
        """Return the density of what should be drawn."""
        if self.geometric:
            return self.geometric * (1.0 - self.geometric) ** (at - 1.0)
        if self.offset[0] == self.offset[1]:
            return np.full(len(at), 1.0 / np.ptp(self.limits()))
        scale = np.linspace(*self.scale, 4001)[:, None]  # the density of a product is a mean over one factor
        inside = (at / scale >= self.offset[0]) & (at / scale <= self.offset[1])
        return (inside / scale).mean(axis=0) / np.ptp(self.offset)


def main() -> None:
    """Build a task, read what it has drawn, and draw one panel per parameter."""
    parser = Parser(__doc__)
    add_build_args(parser)
    parser.set_defaults(task="a1_position", perturbation="low", num_envs=2000)
    parser.add_argument("--out", type=Path, required=True, help="picture to write (png, svg, pdf)")
    args = parser.parse_args()
    options = options_of(args)
    env_cfg, train_cfg = task_registry.get_cfgs(options.task, options)
    set_seed(train_cfg.seed)
    task, _ = task_registry.make_env(options.task, options, env_cfg)
    panels = [panel for read in (initial_state, robot, ground, controller, sensors, events) for panel in read(task)]
    draw(sorted(panels, key=lambda panel: GROUPS.index(panel.group)), args.out)  # events were read last


def drawn(
    task: LeggedRobot, group: str, title: str, values: torch.Tensor, own: np.ndarray | float,
    limits: str = "", offset: str = "", scale: str = "", weight: float = 1.0,
) -> Panel:  # fmt: skip
    """Return the panel of (limits or own + weight x offset) x scale, three settings of which none needs be drawn."""
    rand = task.cfg.domain_rand

    def setting(name: str, neutral: float) -> np.ndarray:
        fixed = not name or name in rand.keep_fixed or not rand.randomize_parameters
        return np.array([neutral, neutral] if fixed else getattr(rand, name))

    first = setting(limits, np.ravel(own)[0]) if limits else own + weight * setting(offset, 0.0)
    return Panel(group, title, values, tuple(first), tuple(setting(scale, 1.0)), own)


def initial_state(task: LeggedRobot) -> list[Panel]:
    """Return the panels of the state at the start of an episode."""
    rand, panel = task.cfg.domain_rand, partial(Panel, "initial state")
    w, x, y, z = task.base_quat.T
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    low, high = rand.action_delay
    bars = np.add([low, high], [-0.5, 0.5] if high > low else 0.0)
    unit = rand.action_delay_unit.replace("_", " ")
    return [
        panel("roll [rad]", roll, rand.init_roll),
        panel("pitch [rad]", torch.asin(2.0 * (w * y - z * x)), rand.init_pitch),
        panel("yaw [rad]", yaw, rand.init_yaw),
        panel("joint angle / nominal", task.dof_pos / task.default_dof_pos, rand.init_dof_pos_scale, own=1.0),
        panel("joint velocity [rad/s]", task.dof_vel, rand.init_dof_vel),
        panel("linear velocity [m/s]", task.sim.qvel[:, :3], rand.init_lin_vel),
        panel("angular velocity [rad/s]", task.base_ang_vel, rand.init_ang_vel),
        panel(f"action delay [{unit}]", task.action_delay.drawn.floor(), bars, bins=high - low + 1),
    ]


def robot(task: LeggedRobot) -> list[Panel]:
    """Return the panels of the robot's body and joints."""
    model, field, panel = task.sim.mj_model, task.sim.field, partial(drawn, task, "robot")
    feet = [model.geom(name).id for name in task.foot_names]
    mass, inertia = model.body_mass[TRUNK], model.body_inertia[TRUNK, 0]
    trunk = {"offset": "trunk_mass_offset", "scale": "trunk_mass_scale"}
    com = field("body_ipos")[:, TRUNK].cpu() - torch.as_tensor(model.body_ipos[TRUNK])
    places = field("geom_pos")[:, feet].cpu() - torch.as_tensor(model.geom_pos[feet])

    def joints(title: str, name: str, first: int = 6) -> Panel:
        return panel(title, field(name)[:, first:], getattr(model, name)[first:], limits=name.replace("jnt", "dof"))

    return [
        panel("trunk mass [kg]", field("body_mass")[:, TRUNK], mass, **trunk),
        panel("trunk inertia, x [kg m²]", field("body_inertia")[:, TRUNK, 0], inertia, **trunk, weight=inertia / mass),
        panel("trunk COM offset [m]", com, 0.0, offset="trunk_com_offset"),
        panel("foot radius [m]", field("geom_size")[:, feet[0], 0], model.geom_size[feet[0], 0], limits="foot_radius"),
        panel("foot offset [m]", places, 0.0, offset="foot_offset"),
        joints("joint damping [N m s/rad]", "dof_damping"),
        joints("joint armature [kg m²]", "dof_armature"),
        joints("joint stiffness [N m/rad]", "jnt_stiffness", first=1),
        joints("joint friction loss [N m]", "dof_frictionloss"),
    ]


def ground(task: LeggedRobot) -> list[Panel]:
    """Return the panels of contacts and gravity, read at a foot."""
    model, field, panel = task.sim.mj_model, task.sim.field, partial(drawn, task, "ground")
    foot = model.geom(task.foot_names[0]).id
    friction, (stiffness, damping) = model.geom_friction[foot, 0], -model.geom_solref[foot]
    solref = -field("geom_solref")[:, foot]
    return [
        panel("ground friction", field("geom_friction")[:, foot, 0], friction, limits="ground_friction"),
        panel("contact stiffness [1/s²]", solref[:, 0], stiffness, limits="contact_stiffness"),
        panel("contact damping [1/s]", solref[:, 1], damping, limits="contact_damping"),
        panel("gravity [m/s²]", -field("gravity")[:, 2], -model.opt.gravity[2], limits="gravity"),
    ]


def controller(task: LeggedRobot) -> list[Panel]:
    """Return the panels of motors and PD controller."""
    control, panel = task.cfg.control, partial(drawn, task, "controller")
    action, torque, change = control.action_scale, control.torque_scale, "action_scale_offset"
    kp, kd = ({"offset": f"{name}_offset", "scale": f"{name}_scale"} for name in ("stiffness", "damping"))
    return [
        panel("motor strength", task.motor_strength[:, 0], 1.0, scale="motor_strength"),
        panel("joint offset [rad]", task.joint_offset, 0.0, offset="joint_offset"),
        panel("action scale [rad]", task.action_scale, action, offset=change),
        panel("torque scale [N m]", task.torque_scale, torque, offset=change, weight=torque / action),
        panel("Kp [N m/rad]", task.p_gains[:, 0], control.stiffness, **kp),
        panel("Kd [N m s/rad]", task.d_gains[:, 0], control.damping, **kd),
    ]


def sensors(task: LeggedRobot) -> list[Panel]:
    """Return the panels of the policy's observations minus the critic's, in the units of the sensors."""
    noise, scales, obs = task.cfg.noise, task.cfg.normalization.obs_scales, task.get_observations()

    def panel(title: str, name: str, start: int, end: int) -> Panel:
        error = (obs["policy"][:, start:end] - obs["critic"][:, start:end]) / getattr(scales, name, 1.0)
        largest = getattr(noise.noise_scales, name) * noise.add_noise
        return Panel("sensors", title, error, (-largest, largest))

    n = task.num_dof
    return [
        panel("gravity vector error", "gravity", 0, 3),
        panel("angular vel. error [rad/s]", "ang_vel", 3, 6),
        panel("joint angle error [rad]", "dof_pos", 9, 9 + n),
        panel("joint vel. error [rad/s]", "dof_vel", 9 + n, 9 + 2 * n),
    ]


def events(task: LeggedRobot) -> list[Panel]:
    """Return the panels of pushes and redraws, in steps without physics whose trunks are at rest."""
    rand, velocity, numbers = task.cfg.domain_rand, task.sim.qvel[:, :3], task.randomization.values
    start, first, pushes = numbers.clone(), torch.full((task.num_envs,), torch.inf, device=task.device), []
    task.reset_buf.fill_(False)
    for step in range(1, STEPS + 1):
        velocity.zero_()
        task._reset_worlds()
        first.clamp_(max=torch.where((numbers != start).any(dim=1), step, torch.inf))
        pushes.append(velocity[(velocity != 0.0).any(dim=1)])
    chance = rand.resampling_probability * rand.randomize_parameters
    until, push = np.multiply([1.0, STEPS], chance > 0.0), np.multiply(rand.push_velocity, rand.push_robots)
    return [
        Panel("events", "push, per axis [m/s]", torch.cat(pushes), push),
        Panel("events", "steps to the next redraw", first, until, own=np.zeros(0), geometric=chance),
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
    handles = [pyplot.Rectangle((0, 0), 1, 1, color=color) for color in COLORS.values()]
    handles += [pyplot.Line2D([], [], color="black"), pyplot.Line2D([], [], color=OWN, linestyle="--")]
    figure.legend(handles, [*GROUPS, "should be", "without draws"], loc="outside upper center", ncols=8, frameon=False)
    save_figure(figure, file)


def draw_panel(axis, panel: Panel) -> None:
    """Draw a histogram without the worlds that keep the robot's own numbers, the ideal density, and the own value."""
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
    kept = (panel.values == np.float32(panel.own)).all(axis=1) & (np.size(panel.own) > 1)
    if kept.any():
        label(0.88, f"{kept.mean():.0%} keep their own")
    bars, edges = np.histogram(panel.values[~kept], panel.bins, (low, high))
    axis.stairs(bars / max(1, panel.values[~kept].size) / np.diff(edges), edges, fill=True, color=COLORS[panel.group])
    at = np.linspace(low, high, 400)
    axis.plot([low, *at, high], [0.0, *panel.density(at), 0.0], color="black", linewidth=1.0)
    axis.set_ylim(0.0, 1.35 * panel.density(at).max())


if __name__ == "__main__":
    run_script(main)
