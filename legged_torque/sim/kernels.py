"""Kernels of resets, random events, random parameters and health: one thread per world, or per number of a world."""

import warp as wp

MAX_POSITION = 1e4  # largest position [m, rad] of a world that has not diverged
MAX_VELOCITY = 1e4  # largest velocity [m/s, rad/s]
MAX_ACCELERATION = 1e10  # largest acceleration [m/s^2, rad/s^2]
MAX_FLOAT = 3.4028234663852886e38  # largest float32
COLUMNS_PER_THREAD = 8  # of replace_non_finite, so that a thread waits for many numbers at a time

Mask, Integers, Numbers = wp.array(dtype=wp.bool), wp.array(dtype=wp.int32), wp.array(dtype=wp.float32)
Rows = wp.array2d(dtype=wp.float32)
"""Types of arguments: a mask of worlds; one integer or number per world; several numbers per world."""


@wp.kernel(enable_backward=False)
def reset_worlds(
    mask: Mask, reference_pose: Numbers, qpos: Rows, qvel: Rows, qacc_warmstart: Rows, ctrl: Rows, sensordata: Rows
):
    """Reset the state of one world."""
    world = wp.tid()
    if mask[world]:
        for i in range(qpos.shape[1]):
            qpos[world, i] = reference_pose[i]
        for i in range(qvel.shape[1]):
            qvel[world, i] = 0.0
            qacc_warmstart[world, i] = 0.0
        for i in range(ctrl.shape[1]):
            ctrl[world, i] = 0.0
        for i in range(sensordata.shape[1]):
            sensordata[world, i] = 0.0


@wp.kernel(enable_backward=False)
def clear_nan_ctrl(ctrl: Rows, diverged: Mask):
    """Set the controls of a world with a NaN among them to zero, as ``mj_step`` does, and mark the world."""
    world = wp.tid()
    is_nan = bool(False)
    for i in range(ctrl.shape[1]):
        is_nan = is_nan or wp.isnan(ctrl[world, i])
    if is_nan:
        diverged[world] = True
        for i in range(ctrl.shape[1]):
            ctrl[world, i] = 0.0


@wp.func
def turn(qpos: Rows, world: int, roll: float, pitch: float, yaw: float):
    """Write the quaternion (w, x, y, z) of one world's trunk, turned about the world's x, then y, then z axis."""
    about_x = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), roll)  # Warp's own are (x, y, z, w)
    about_y = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), pitch)
    quat = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw) * about_y * about_x
    qpos[world, 3] = quat[3]
    for i in range(3):
        qpos[world, 4 + i] = quat[i]


@wp.kernel(enable_backward=False)
def flag_diverged(
    qpos: Rows, qvel: Rows, qacc: Rows, ctrl: Rows, overflow: Integers, diverged: Mask, overflow_seen: Integers
):
    """Check one position, velocity, acceleration and control of a world; the comparisons are false for NaN."""
    world, i = wp.tid()  # so that neighbours in memory are read together
    if not wp.abs(qpos[world, i]) <= wp.static(MAX_POSITION):
        diverged[world] = True
    if i < qvel.shape[1]:
        if not wp.abs(qvel[world, i]) <= wp.static(MAX_VELOCITY):
            diverged[world] = True
        if not wp.abs(qacc[world, i]) <= wp.static(MAX_ACCELERATION):
            diverged[world] = True
    if i < ctrl.shape[1]:
        torque = ctrl[world, i]
        if not wp.abs(torque) <= wp.static(MAX_FLOAT):
            diverged[world] = True
    if i == 0:
        overflow_seen[world] = overflow_seen[world] | overflow[world]


@wp.func
def draw_command(seed: int, low: Numbers, span: Numbers, commands: Rows, headings: Numbers, world: int):
    """Write the command and the heading of one world."""
    random = wp.rand_init(seed, 1)
    for i in range(commands.shape[1]):
        commands[world, i] = low[i] + span[i] * wp.randf(random)
    heading = commands.shape[1]
    headings[world] = low[heading] + span[heading] * wp.randf(random)


@wp.kernel(enable_backward=False)
def draw_commands(mask: Mask, seeds: Integers, low: Numbers, span: Numbers, commands: Rows, headings: Numbers):
    """Draw the command of one world."""
    world = wp.tid()
    if mask[world]:
        draw_command(seeds[world], low, span, commands, headings, world)


@wp.kernel(enable_backward=False)
def apply_random_events(
    # In:
    is_new: Mask,
    seeds: Integers,
    chances: wp.vec4,
    push_velocity: wp.vec2,
    push_set_factor: float,
    angles: Rows,
    low: Numbers,
    span: Numbers,
    # Out:
    new_commands: Mask,
    new_parameters: Mask,
    commands: Rows,
    headings: Numbers,
    qpos: Rows,
    qvel: Rows,
):
    """Apply the random events of one world: its initial orientation, a command, new parameters, a push.

    ``chances`` are those of new commands, of new parameters, of pushes, and of a push to add its velocity.
    """
    world = wp.tid()
    random = wp.rand_init(seeds[world], 0)
    drawn = wp.vec4(wp.randf(random), wp.randf(random), wp.randf(random), wp.randf(random))
    if is_new[world]:
        turn(qpos, world, angles[world, 0], angles[world, 1], angles[world, 2])
    new_commands[world] = is_new[world] or drawn[0] < chances[0]
    if new_commands[world]:
        draw_command(seeds[world], low, span, commands, headings, world)
    new_parameters[world] = is_new[world] or drawn[1] < chances[1]
    if drawn[2] < chances[2]:
        lowest, width = push_velocity[0], push_velocity[1] - push_velocity[0]
        shares = wp.vec3(wp.randf(random), wp.randf(random), wp.randf(random))
        velocity = wp.vec3(lowest, lowest, lowest) + width * shares
        is_added = drawn[3] < chances[3]
        velocity *= wp.where(is_added, 1.0, push_set_factor)
        for i in range(3):
            qvel[world, i] = velocity[i] + wp.where(is_added, qvel[world, i], 0.0)


@wp.struct
class RandomNumber:
    """One random number: its distribution, its place in memory, and how it is scaled to [-1, 1]."""

    address: wp.uint64  # of the first world's number
    stride: wp.uint64  # from world to world [bytes]
    draw: wp.int32  # index of its random stream
    column_draw: wp.int32  # index of the stream of the column's own factor, -1 without
    place: wp.int32  # column of the listed values, -1 without
    base: wp.float32
    weight: wp.float32
    offset_low: wp.float32
    offset_span: wp.float32
    scale_low: wp.float32
    scale_span: wp.float32
    column_low: wp.float32
    column_span: wp.float32
    own_value: wp.float32
    keep_probability: wp.float32
    middle: wp.float32
    per_half_range: wp.float32
    lowest: wp.float32
    highest: wp.float32


@wp.kernel(enable_backward=False)
def draw_parameters(mask: Mask, seeds: Integers, numbers: wp.array(dtype=RandomNumber), values: Rows):
    """Draw one number of one world."""
    world, column = wp.tid()
    if mask[world]:
        row = numbers[column]
        random = wp.rand_init(seeds[world], row.draw)
        offset = row.offset_low + row.offset_span * wp.randf(random)
        scale = row.scale_low + row.scale_span * wp.randf(random)
        if row.column_draw >= 0:
            scale *= row.column_low + row.column_span * wp.randf(wp.rand_init(seeds[world], row.column_draw))
        value = wp.clamp((row.base + row.weight * offset) * scale, row.lowest, row.highest)
        if wp.randf(wp.rand_init(seeds[world], 0)) < row.keep_probability:
            value = row.own_value
        target = wp.array(ptr=row.address + wp.uint64(world) * row.stride, shape=(1,), dtype=wp.float32)
        target[0] = value
        if row.place >= 0:
            values[world, row.place] = (value - row.middle) * row.per_half_range


@wp.struct
class WatchedNumber:
    """A number of every world that must be finite, anywhere in memory."""

    address: wp.uint64  # of the first world's
    stride: wp.uint64  # from world to world [bytes]
    tensor: wp.int32  # index of its tensor
    healthy: wp.float32  # its replacement


@wp.func
def number_of(column: WatchedNumber, world: int) -> Numbers:
    """Return one number of a world, as an array of length 1."""
    return wp.array(ptr=column.address + wp.uint64(world) * column.stride, shape=(1,), dtype=wp.float32)


@wp.kernel(enable_backward=False)
def replace_non_finite(
    columns: wp.array(dtype=WatchedNumber),
    excused: Mask,
    diverged: Mask,
    marks: Mask,
    found: wp.array2d(dtype=wp.int32),
    counts: Integers,
):
    """Replace numbers of one world that are not finite; mark the world, and count the tensors unless it is excused."""
    world, part = wp.tid()
    parts = (columns.shape[0] + wp.static(COLUMNS_PER_THREAD - 1)) // wp.static(COLUMNS_PER_THREAD)
    bad = int(0)
    for i in range(wp.static(COLUMNS_PER_THREAD)):  # nothing is written here, so that no load waits for another
        column = wp.min(i * parts + part, columns.shape[0] - 1)  # so that neighbours in memory are read together
        number = number_of(columns[column], world)
        bad += wp.where(wp.abs(number[0]) <= wp.static(MAX_FLOAT), 0, 1)  # faster than isfinite
    if bad == 0:
        return
    for column in range(part, columns.shape[0], parts):
        place = columns[column]
        number = number_of(place, world)
        if not wp.abs(number[0]) <= wp.static(MAX_FLOAT):
            number[0] = place.healthy
            diverged[world] = True
            marks[world] = True
            if not excused[world] and wp.atomic_max(found, place.tensor, world, 1) == 0:
                wp.atomic_add(counts, place.tensor, 1)
