"""Proximal policy optimization: rsl_rl's PPO that runs on the device from end to end."""

from legged_torque.learning.ppo.algorithm import LOSS_NAMES, OnDevicePPO

__all__ = ["LOSS_NAMES", "OnDevicePPO"]
