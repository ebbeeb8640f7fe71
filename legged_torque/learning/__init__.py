"""What this project adds to rsl_rl: the runner, the PPO update that never waits for the host, the multi-head actor."""
