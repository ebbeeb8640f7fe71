"""The drives of all worlds in a physics step as a kernel: late commands, biased encoders, a trunk that is held."""

import warp as wp

TAU, POS, VEL, KP, KD = (wp.constant(number) for number in range(5))  # rows of a command
VISCOUS, BIAS, DELAY = (wp.constant(row) for row in (1, 3, 4))  # rows of a candidate
Rows, Table = wp.array2d(dtype=wp.float32), wp.array3d(dtype=wp.float32)


@wp.func
def asked(commands: Table, step: int, substeps: int, joint: int, pos: float, vel: float) -> float:
    """tau + Kp (q* - q) + Kd (qd* - qd) [N m] of the command of a physics step, or of the first or last one."""
    tick = wp.min(wp.max(step, 0) / substeps, commands.shape[0] - 1)
    torque = commands[tick, TAU, joint] + commands[tick, KP, joint] * (commands[tick, POS, joint] - pos)
    return torque + commands[tick, KD, joint] * (commands[tick, VEL, joint] - vel)


@wp.kernel(enable_backward=False)
def drive(
    taken: wp.array2d(dtype=wp.int32),  # how many steps so far, (worlds, joints)
    substeps: int,  # physics steps per tick
    rate: float,  # physics steps per second
    joints: wp.array(dtype=wp.int32),  # places of the log's joints in the model
    commands: Table,  # (ticks, 5, joints)
    limits: Rows,  # lowest and highest torques [N m], (2, joints)
    trunk: wp.array(dtype=wp.float32),  # its position and orientation (7,)
    candidates: Table,  # (worlds, 5, joints)
    past: Rows,  # velocities before the last step [rad/s], (worlds, joints)
    ahead: Rows,  # what was added to them for it [rad/s], (worlds, joints)
    qpos: Rows,
    qvel: Rows,
    ctrl: Rows,
    seen: wp.array4d(dtype=wp.float32),  # (ticks, worlds, 2, joints)
):
    """Write the torque of one joint of one world and, at the start of a tick, what its encoder says.

    Semi-implicit steps hold velocities of half a step ago, and a torque acts half a step before and after its time.
    So a step starts from velocities that are extrapolated by half of it, which is taken back afterwards; viscous
    friction is explicit; and a torque is the mean of the commands in its step. The error is then of second order.
    """
    world, place = wp.tid()
    joint = joints[place]
    step = taken[world, place]
    taken[world, place] = step + 1
    added = ahead[world, place]
    held = qvel[world, 6 + joint] - added
    ahead[world, place] = 0.5 * (held - past[world, place])
    past[world, place] = held
    vel = held + ahead[world, place]
    qvel[world, 6 + joint] = vel
    qpos[world, 7 + joint] = qpos[world, 7 + joint] - added / rate
    pos = qpos[world, 7 + joint] - candidates[world, BIAS, place]
    if step % substeps == 0 and step / substeps < seen.shape[0]:
        seen[step / substeps, world, 0, place] = pos
        seen[step / substeps, world, 1, place] = vel
    late = rate * candidates[world, DELAY, place] + 0.5
    newest = step - int(wp.floor(late))
    share = late - wp.floor(late)
    torque = (1.0 - share) * asked(commands, newest, substeps, place, pos, vel)
    torque += share * asked(commands, newest - 1, substeps, place, pos, vel)
    torque = wp.clamp(torque, limits[0, place], limits[1, place])
    ctrl[world, joint] = torque - candidates[world, VISCOUS, place] * vel
    if place == 0:
        for i in range(7):
            qpos[world, i] = trunk[i]
        for i in range(6):
            qvel[world, i] = 0.0
