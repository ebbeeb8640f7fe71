"""MuJoCo's physics step for legged robots, as one kernel: see :mod:`~legged_torque.sim.fused.step`.

The files have MuJoCo's names for the parts of a step: ``smooth`` (dynamics without constraints), ``contact`` and
``constraint`` (their rows), ``solver`` (Newton), ``integrate``; ``set_const`` recomputes what follows from masses.
``surface`` and ``map_contact`` are what a height map needs in the place of a plane.

Two words are not MuJoCo's. A *branch* is a leg: a chain of hinge joints that hangs on the trunk; ``b`` counts branches,
``j`` the joints of one, outwards, and a *depth* is a number of joints from the trunk. A *lane* is one of the threads
that share a world: on a GPU there is one per branch, on a CPU one per world, which has all branches.
"""
