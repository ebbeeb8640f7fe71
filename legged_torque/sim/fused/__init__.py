"""MuJoCo's physics step for legged robots on a plane, as one kernel: see :mod:`~legged_torque.sim.fused.step`."""
