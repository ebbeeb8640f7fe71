"""Learning: the trainer, rsl_rl's runner on top of it, PPO on the device, evaluation during training."""
