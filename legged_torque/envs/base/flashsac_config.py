"""Settings of FlashSAC, with the names of rsl_rl_flashsac and the published values for 1024 worlds."""

from typing import Annotated, Any, Literal

from legged_torque.utils.config import Section
from legged_torque.utils.limits import Count, Fraction, Limits, Positive

FLASHSAC = "legged_torque.learning.flashsac:FlashSAC"


class FlashSACCfg(Section):
    """The section ``flashsac``; of ``algorithm``, it reads class_name, gamma, use_mixed_precision, mirror images."""

    replay_buffer_size: Count = 10_000_000  # steps that are kept, of all worlds together
    buffer_min_length: Count = 100_000  # steps before the first update, with uniform actions
    buffer_obs_dtype: Literal["float32", "bfloat16"] = "float32"  # of observations in it; bfloat16 halves its memory
    save_replay: bool = False  # whether the newest checkpoint keeps it, for a resumed training with the same bits
    updates_per_step: Count = 2  # gradient steps per control step of all worlds
    mini_batch_size: Count = 2048  # samples of a gradient step, to which mirror images are added
    n_steps: Annotated[int, Limits(1, 100)] = 3  # control steps before a return goes on with the critic's estimate
    learning_rate_peak: Fraction = 3e-4  # of Adam at the start of a training
    learning_rate_end: Fraction = 1.5e-4  # and at its end; in between, half a cosine
    actor_update_period: Count = 2  # gradient steps of the critic for each of the actor
    critic_target_update_tau: Fraction = 0.01  # share by which the target follows the critic after each gradient step
    temp_initial_value: Positive = 0.01  # weight of the entropy at first
    temp_target_sigma: Positive = 0.15  # standard deviation of actions in [-1, 1] whose entropy it aims at
    actor_noise_zeta_mu: Positive = 2.0  # noise is repeated for n steps with a probability in proportion to n^-mu
    actor_noise_zeta_max: Annotated[int, Limits(1, 1e6)] = 16  # the largest n
    normalized_g_max: Positive = 5.0  # largest return that the critic knows, in units of scaled rewards
    action_bound: Positive = 2.0  # largest action, in units of control.action_scale and torque_scale; ours

    class actor:  # the policy's network
        hidden_dim: Annotated[int, Limits(1, 1e6)] = 128  # size of its features
        num_blocks: Annotated[int, Limits(1, 100)] = 2  # of two layers each

    class critic:  # both critics
        hidden_dim: Annotated[int, Limits(1, 1e6)] = 256  # size of their features; below 64 they learn badly
        num_blocks: Annotated[int, Limits(1, 100)] = 2  # of two layers each
        num_bins: Annotated[int, Limits(2, 10_000)] = 101  # values of their distributions


def preset() -> dict[str, dict[str, Any]]:
    """Return the changes that choose FlashSAC as published, but with an update after 8 control steps, not 1."""
    runner = {"num_steps_per_env": 8, "total_steps": 50_000_000, "save_interval": 500}
    worlds = {"num_envs": 1024, "num_envs_cpu": 1024}
    rewards = {"only_positive_rewards": False}  # better for quadrupeds, see docs/tried.md
    return {"env": worlds, "rewards": rewards, "runner": runner, "algorithm": {"class_name": FLASHSAC, "gamma": 0.99}}
