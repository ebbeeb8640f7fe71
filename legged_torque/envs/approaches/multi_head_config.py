"""Settings of multi-head control, see :mod:`~legged_torque.envs.approaches.multi_head`."""

from typing import Any

from legged_torque.envs.approaches.torque_curriculum_config import TorqueCurriculumCfg
from legged_torque.envs.base.clocks import whole_steps
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO, LinearChange
from legged_torque.utils.config import Section
from legged_torque.utils.limits import Count, Sizes


class TorqueMultiHeadCfg(LeggedRobotCfg):
    """Settings of multi-head control whose PD part fades to 0."""

    class control:
        class mixing(Section):
            update_interval: Count = 64_000  # [total steps]; weights change between rollouts only

            class pd(LinearChange):
                start, end = 1.0, 0.0
                t_start, t_end = 0, 50_000_000

            class torque(LinearChange):
                start, end = 1.0, 1.0
                t_start, t_end = 0, 50_000_000


class MultiHeadCfg(TorqueMultiHeadCfg):
    """Settings of multi-head control whose PD part fades to 0.1."""

    class control:
        class mixing:
            class pd:
                end = 0.1


class CurriculumMultiHeadCfg(TorqueMultiHeadCfg, TorqueCurriculumCfg):
    """Settings of torque multi-head control with the rewards of the torque curriculum."""


STEPS = 4  # control steps at 200 Hz of one at 50 Hz


class MultiHeadTwoRatesCfg(MultiHeadCfg):
    """Settings of multi-head control with torques at 200 Hz and positions at 50 Hz, the paper's future work.

    Random events are as frequent in time as at 50 Hz.
    """

    class commands:
        resampling_probability = 0.0005  # per control step: about every 10 s at 200 Hz

    class control:
        decimation = 1  # control steps are physics steps
        position_interval: Count = 4  # control steps for which position actions are held

    class domain_rand:
        resampling_probability = 0.0005
        push_probability = 0.0005

    def set_clocks(self, policy_hz: float | None, physics_hz: float | None) -> float:
        """Set the rates; position actions are held for the same time."""
        ratio = super().set_clocks(policy_hz, physics_hz)
        self.control.position_interval = whole_steps(
            "control.position_interval", self.control.position_interval * ratio
        )
        return ratio


class MultiHeadCfgPPO(LeggedRobotCfgPPO):
    """Training of multi-head control."""

    class actor:
        class_name = "legged_torque.learning.multi_head:MultiHeadModel"  # Figure 2
        hidden_dims = [512, 256]  # shared by both heads
        head_hidden_dims: Sizes = [128]  # of either head

    def presets(self) -> dict[str, dict[str, Any]]:
        """Return those of other approaches; on a laptop, heads are small and the PD part fades once the robot walks."""
        named = super().presets()
        laptop, fading = named["laptop"], {"t_start": 4_000_000, "t_end": 10_000_000}
        laptop["actor"] |= {"head_hidden_dims": [64]}
        laptop["runner"] |= {"walks_after": 4_500_000}  # docs/results/laptop.csv.gz
        laptop["control"] = {"mixing": {"pd": fading}}
        return named


class MultiHeadTwoRatesCfgPPO(MultiHeadCfgPPO):
    """Training of multi-head control with two rates: discounts per second and evaluated time are those at 50 Hz."""

    class runner:
        num_steps_per_env = 48

    class evaluation:
        num_samples = 128_000  # world steps of one evaluation: as much time as at 50 Hz

    class algorithm:
        num_mini_batches = 8  # of as many samples as at 50 Hz
        gamma, lam = 0.98**0.25, 0.95**0.25

    def presets(self) -> dict[str, dict[str, Any]]:
        """Return those of 50 Hz, with the same discounts per second."""
        named = super().presets()
        for algorithm in (changes.get("algorithm", {}) for changes in named.values()):
            algorithm |= {key: algorithm[key] ** (1 / STEPS) for key in ("gamma", "lam") if key in algorithm}
        return named
