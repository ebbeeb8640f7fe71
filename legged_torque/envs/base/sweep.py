"""Metrics by the value of one random parameter: what payload, friction, delay or push a policy bears.

Worlds draw the parameter in its range, and each step counts in the part of the range in which its world was. So one
rollout measures all values, in as many worlds as fit.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from legged_torque.envs.base.clocks import delays
from legged_torque.envs.base.metrics import WalkingMetrics
from legged_torque.motors.config import DelayCfg
from legged_torque.utils.errors import UserError
from legged_torque.utils.metrics import estimate
from legged_torque.utils.options import DELAYS, PUSH

NUM_PARTS = 8
REST, WATCHED = 2.0, 3.0  # seconds between pushes without and with a look at falls


class Sweep:
    """Sums of the metrics for each part of a parameter's range.

    Attributes:
        name: Of the parameter.
        unit: Of its values.
        edges: Between the parts, and at the ends. Shape: (parts + 1,).
    """

    def __init__(self, task: Any, name: str) -> None:
        """Start with empty sums; a UserError if the parameter has one value only, or several numbers of its own."""
        setting, links = DELAYS.get(name, f"domain_rand.{name}"), task.motors.links.items()
        if name == "action_delay":
            own = (f"motors.{key}.range" for key, link in links if isinstance(link.cfg, DelayCfg))
            setting = next(own, setting)
        kinds = (task.events.parameters, task.events.initial_state)
        drawn = next((kind for kind in kinds if name in kind.sizes), None)
        if drawn is None:
            draws = {each.name: each.same_draw_as or each.name for kind in kinds for each in kind.parameters}
            same = (each for kind in kinds for each in kind.parameters if draws[each.name] == draws.get(name))
            if other := next((each.name for each in same if each.is_drawn), None):
                raise UserError(f"{name} has no draw of its own, but that of {other}: sweep {other}")
            raise UserError(f"{name} is {'fixed' if name in draws else 'always 0'}: give {setting} a range with --set")
        if drawn.sizes[name] > 1:
            raise UserError(f"--sweep takes parameters with one number per world; {name} has {drawn.sizes[name]}")
        place, low, high = drawn.range_of(name)
        if low == high or (name in DELAYS and round(high - low) == 1):
            raise UserError(f"{name} is always {low:.3g}: give {setting} a range with --set")
        sign = -1.0 if high <= 0.0 else 1.0  # MuJoCo has solref and gravity as negative numbers
        low, high = sorted((sign * low, sign * high))
        self.name, self._values, self._sign = name, drawn.values[:, place], sign
        self.unit, parts = next(each.unit for each in drawn.parameters if each.name == name), NUM_PARTS
        if name in DELAYS:
            unit = delays(task.cfg)[setting.removesuffix(".range")].unit
            low, high, self.unit = round(low), round(high), unit.replace("milliseconds", "physics_steps")  # as counted
            parts = high - low
        self.edges = [float(f"{edge:.6g}") for edge in torch.linspace(low, high, parts + 1).tolist()]  # of float32
        self._metrics = [WalkingMetrics(task) for _ in range(parts)]
        self._before: Tensor | None = None

    def add_step(self, commands: Tensor) -> None:
        """Add the step that the task has just made, but for the first; as :meth:`WalkingMetrics.add_step`."""
        parts = len(self._metrics)
        now = ((self._sign * self._values + 1.0) / 2.0 * parts).long().clamp(0, parts - 1)
        if self._before is not None:  # a robot that fell has another value by now
            for part, metrics in enumerate(self._metrics):
                metrics.add_step(commands, self._before == part)
        self._before = now

    def lines(self) -> Iterator[str]:
        """Give the table as text."""
        head = f"{self.name} [{self.unit}]"
        yield f"  {head:<23}{'tracking [share]':>18} {'falls per minute':>18} {'cost':>16}"
        for part in self.table():
            shown = [part["metrics"][name] for name in ("track_percentage", "falls_per_minute", "cost_of_transport")]
            texts = ["{mean:9.3f} +- {standard_error:.3f}".format(**each) for each in shown]
            yield " ".join([f"  {part['from']:9.4g} to {part['to']:9.4g}", *texts])

    def table(self) -> list[dict[str, Any]]:
        """Return "from" and "to" of each part, and its "metrics" with means and standard errors."""
        ends = zip(self.edges, self.edges[1:], self._metrics, strict=False)
        return [
            {"from": low, "to": high, "metrics": {name: asdict(value) for name, value in part.estimates().items()}}
            for low, high, part in ends
        ]


class PushSweep:
    """Shares of pushes after which a robot falls, by the velocity that they add to the trunk's.

    Every :data:`REST` + :data:`WATCHED` seconds, all robots are pushed at once, each in a direction and with a velocity
    of its own, up to the highest of ``domain_rand.push_velocity``. A push counts unless the episode has just begun, or
    ends by its time soon after.
    """

    name, unit = PUSH, "m/s"

    def __init__(self, task: Any) -> None:
        """Start with no pushes."""
        highest = max(map(abs, task.cfg.domain_rand.push_velocity))
        if not highest:
            raise UserError(f"{PUSH} is always 0: give domain_rand.{PUSH} a range with --set")
        self._task, self._step, self.edges = task, 0, torch.linspace(0.0, highest, NUM_PARTS + 1).tolist()
        self._rest, self._watched = (round(time / task.dt) for time in (REST, WATCHED))
        self._mass = float(task.sim.mj_model.body_mass.sum())
        zeros = torch.zeros(task.num_envs, device=task.device)
        self._part, self._counts, self._fell = zeros.long(), zeros.bool(), zeros.bool()
        self._pushes, self._falls = zeros.repeat(NUM_PARTS, 1), zeros.repeat(NUM_PARTS, 1)

    def add_step(self, commands: Tensor) -> None:
        """Look at the step that the task has just made, and push if it is time."""
        task, time = self._task, self._step % (self._rest + self._watched)
        self._step += 1
        if time > self._rest:
            self._fell |= task.reset_buf & ~task.time_out_buf
            self._counts &= self._fell | ~task.reset_buf
        elif time == self._rest:
            self._counts, self._fell = task.episode_length_buf * task.dt > REST / 2.0, torch.zeros_like(self._fell)
            share, angle = torch.rand(2, task.num_envs, device=task.device)
            self._part = (share * NUM_PARTS).long().clamp(max=NUM_PARTS - 1)
            speed, angle = share * self.edges[-1], 2.0 * math.pi * angle
            task.sim.qvel[:, :2] += torch.stack([speed * angle.cos(), speed * angle.sin()], dim=1)
        if time == self._rest + self._watched - 1:
            member = torch.nn.functional.one_hot(self._part, NUM_PARTS).T * self._counts
            self._pushes += member
            self._falls += member * self._fell

    def lines(self) -> Iterator[str]:
        """Give the table as text."""
        yield f"  {f'push [{self.unit}]':<23}{'[N s] of all parts':>20} {'pushes':>8} {'fell [share]':>18}"
        for part in self.table():
            impulse = "{:9.3g} to {:6.3g}".format(*part["impulse"])
            fell = "{mean:9.3f} +- {standard_error:.3f}".format(**part["fell"])
            yield f"  {part['from']:9.4g} to {part['to']:9.4g} {impulse:>20} {part['pushes']:>8} {fell:>18}"

    def table(self) -> list[dict[str, Any]]:
        """Return for each part "from" and "to", "impulse" [N s], the number of "pushes", and the share that "fell"."""
        rows = zip(self.edges, self.edges[1:], self._pushes.double().cpu(), self._falls.double().cpu(), strict=False)
        return [
            {"from": low, "to": high, "impulse": [low * self._mass, high * self._mass], "pushes": int(pushes.sum())}
            | {"fell": asdict(estimate(falls.numpy(), pushes.numpy()))}
            for low, high, pushes, falls in rows
        ]
