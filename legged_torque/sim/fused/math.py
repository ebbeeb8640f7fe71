"""Quaternions, small matrices, and sums over the threads of one world."""

import warp as wp

from legged_torque.sim.fused.types import AnyColumns, AnyMatrix, AnyVector


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned first = (threadIdx.x & 31u) & ~(unsigned(threads) - 1u);
    const unsigned mask = ((1u << threads) - 1u) << first;
    for (int offset = threads / 2; offset > 0; offset /= 2) value += __shfl_xor_sync(mask, value, offset);
#endif
    return value;
""")
def group_sum(value: float, threads: int) -> float:
    """Return the sum of a value over the ``threads`` threads that share a world, the same to the last bit in each.

    On a CPU a world has one thread, and the sum is the value.
    """
    ...


@wp.func
def sum_before(value: float, thread: int, threads: int) -> float:
    """Return the sum of a value over the threads of a world that come before this one."""
    before = float(0.0)
    for other in range(threads - 1):
        of_other = group_sum(wp.where(thread == other, value, 0.0), threads)
        before += wp.where(other < thread, of_other, 0.0)
    return before


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest_bit(bits: int) -> int:
    """Return the place of the lowest bit that is set, of some."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned first = (threadIdx.x & 31u) & ~(unsigned(threads) - 1u);
    __syncwarp(((1u << threads) - 1u) << first);
#endif
""")
def sync_group(threads: int):
    """Synchronize the threads of a world, with their writes to memory."""
    ...


@wp.func
def group_sum3(value: wp.vec3, threads: int) -> wp.vec3:
    """Return the sum of a vector over the threads of a world."""
    return wp.vec3(group_sum(value[0], threads), group_sum(value[1], threads), group_sum(value[2], threads))


@wp.func
def group_sum33(value: wp.mat33, threads: int) -> wp.mat33:
    """Return the sum of a matrix over the threads of a world."""
    result = wp.mat33()
    for i in range(3):
        for j in range(3):
            result[i, j] = group_sum(value[i, j], threads)
    return result


@wp.func
def symmetric(diagonal: wp.vec3, rest: wp.vec3) -> wp.mat33:
    """Return a symmetric matrix from xx, yy, zz and xy, xz, yz."""
    return wp.mat33(diagonal[0], rest[0], rest[1], rest[0], diagonal[1], rest[2], rest[1], rest[2], diagonal[2])


@wp.func
def group_sum33_symmetric(value: wp.mat33, threads: int) -> wp.mat33:
    """Return the sum of a symmetric matrix over the threads of a world."""
    rest = group_sum3(wp.vec3(value[0, 1], value[0, 2], value[1, 2]), threads)
    return symmetric(group_sum3(wp.get_diag(value), threads), rest)


@wp.func
def quat_multiply(a: wp.quat, b: wp.quat) -> wp.quat:
    """Return the product of two quaternions (w, x, y, z), in MuJoCo's order, not Warp's."""
    return wp.quat(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def quat_rotation(axis: wp.vec3, angle: float) -> wp.quat:
    """Return the quaternion (w, x, y, z) of a rotation about a unit axis [rad]."""
    s = wp.sin(0.5 * angle)
    return wp.quat(wp.cos(0.5 * angle), s * axis[0], s * axis[1], s * axis[2])


@wp.func
def quat_to_matrix(q: wp.quat) -> wp.mat33:
    """Return the rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.func
def column(m: AnyColumns, j: int) -> wp.vec3:
    """Return a column of a matrix with three rows."""
    return wp.vec3(m[0, j], m[1, j], m[2, j])


@wp.func
def with_column(m: AnyColumns, j: int, v: wp.vec3):
    """Return a matrix with another column."""
    m[0, j] = v[0]
    m[1, j] = v[1]
    m[2, j] = v[2]
    return m


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return rsqrtf(value);
#else
    return 1.0f / sqrt(value);
#endif
""")
def inverse_sqrt(value: float) -> float:
    """Return one over the square root, a single instruction on a GPU."""
    ...


@wp.func
def cholesky(a: AnyMatrix):
    """Return the lower factor of a symmetric matrix, with the inverse of its diagonal in the diagonal's place."""
    lower = type(a)()
    for j in range(len(a)):
        pivot = a[j, j]
        for k in range(len(a)):
            if k < j:
                pivot -= lower[j, k] * lower[j, k]
        inverse = inverse_sqrt(wp.max(pivot, 1.0e-12))
        lower[j, j] = inverse
        for i in range(len(a)):
            if i > j:
                rest = a[i, j]
                for k in range(len(a)):
                    if k < j:
                        rest -= lower[i, k] * lower[j, k]
                lower[i, j] = rest * inverse
    return lower


@wp.func
def forward_solve(lower: AnyMatrix, b: AnyVector):
    """Return the solution of lower x = b, of a factor as :func:`cholesky` returns it."""
    x = type(b)()
    for i in range(len(b)):
        rest = b[i]
        for k in range(len(b)):
            if k < i:
                rest -= lower[i, k] * x[k]
        x[i] = rest * lower[i, i]
    return x


@wp.func
def cholesky_solve(lower: AnyMatrix, b: AnyVector):
    """Return the solution of a x = b from the factor of a."""
    x = forward_solve(lower, b)
    for reverse in range(len(b)):
        i = len(b) - 1 - reverse
        rest = x[i]
        for k in range(len(b)):
            if k > i:
                rest -= lower[k, i] * x[k]
        x[i] = rest * lower[i, i]
    return x
