"""MuJoCo's physics step for legged robots, as one kernel: see :mod:`~legged_torque.sim.fused.step`.

Files are named after MuJoCo's stages: ``smooth`` (dynamics without constraints), ``collision``, ``constraint`` (rows),
``solver`` (of one branch) and ``newton`` (of a world), ``integrate``, ``set_const`` (constants derived from masses).
Endings ``_map`` and ``_self`` stand for contacts with a height map and between parts of the robot.

Functions take their arrays in three groups, ``Model``, ``State`` and ``Scratch``. Two words are not MuJoCo's: a
*branch* is a leg, a chain of hinge joints that hangs on the trunk (``b`` counts branches, ``j`` the joints of one,
outwards), and a *depth* is a number of joints from the trunk.
"""
