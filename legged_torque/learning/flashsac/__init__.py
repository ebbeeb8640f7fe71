"""FlashSAC, a learner that keeps what it has seen and needs fewer samples than PPO."""

from legged_torque.learning.flashsac.learner import FlashSAC as FlashSAC
