"""Settings of policies that act at every physics step, at 200 Hz, with the discounts and events per second of 50 Hz."""

from typing import Any

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO

STEPS = 4  # control steps at 200 Hz of one at 50 Hz


class FastCfg(LeggedRobotCfg):
    """Settings of control at 200 Hz. Random events are as frequent in time as at 50 Hz."""

    class commands:
        resampling_probability = 0.0005  # per control step: about every 10 s at 200 Hz

    class control:
        decimation = 1  # control steps are physics steps

    class domain_rand:
        resampling_probability = 0.0005
        push_probability = 0.0005


class FastCfgPPO(LeggedRobotCfgPPO):
    """Training at 200 Hz: discounts per second and evaluated time are those at 50 Hz."""

    class runner:
        num_steps_per_env = 48

    class evaluation:
        num_samples = 128_000  # world steps of one evaluation: as much time as at 50 Hz

    class algorithm:
        num_mini_batches = 8  # of as many samples as at 50 Hz
        gamma, lam = 0.98**0.25, 0.95**0.25

    def presets(self) -> dict[str, dict[str, Any]]:
        """Return those of 50 Hz, with the same discounts per second and evaluated time."""
        named = super().presets()
        for changes in named.values():
            algorithm, evaluation = changes.get("algorithm", {}), changes.get("evaluation", {})
            algorithm |= {key: algorithm[key] ** (1 / STEPS) for key in ("gamma", "lam") if key in algorithm}
            evaluation |= {key: STEPS * evaluation[key] for key in ("num_samples",) if key in evaluation}
        return named
