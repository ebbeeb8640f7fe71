"""Collision of spheres, capsules and boxes with each other, with MuJoCo's contacts."""

import warp as wp

from legged_torque.sim.fused.math import column
from legged_torque.sim.fused.types import AnyPairContacts, mat23, mat83, vec8

MAX_CORNERS = wp.constant(8)
"""Of a polygon."""
NEVER = wp.constant(1.0e30)
TINY = wp.constant(1.0e-18)
PARALLEL = wp.constant(1.0e-8)
"""Lines whose directions have less than this squared sine of an angle between them are parallel."""
EDGE_NOISE = wp.constant(1.0e-7)
"""Edges of two boxes with less than this squared sine of an angle between them have no axis across both."""
SLACK = wp.constant(1.0e-6)
"""Rounding of the distance of two boxes, relative to their sizes, and how much nearer an edge must be than a face."""
LIKE_FACE, BETTER = wp.constant(0.99), wp.constant(0.05)
"""An axis across two edges with this cosine to a face's normal is taken for it, unless it is so much nearer."""
DUPLICATE = wp.constant(1.0e-10)
"""Corners of a clipped face whose squared distance is this share of the face's size are one."""


@wp.struct
class Shape:
    """A geom in the world, from the trunk's origin."""

    pos: wp.vec3
    rot: wp.mat33
    size: wp.vec3


@wp.struct
class PairContacts:
    """The contacts of two geoms: the first ``count`` entries."""

    count: wp.int32
    dist: wp.vec2  # negative [m]
    pos: mat23  # midway between the surfaces
    normal: mat23  # from the first geom to the second


@wp.struct
class BoxContacts:
    """The same, with room for those of two boxes; kernels that have it spill more registers."""

    count: wp.int32
    dist: vec8
    pos: mat83
    normal: mat83


@wp.struct
class Polygon:
    """Some corners in order."""

    count: wp.int32
    corner: mat83


@wp.func
def add_contact(out: AnyPairContacts, dist: float, pos: wp.vec3, normal: wp.vec3):
    """Return contacts with one more, if it is one."""
    if dist < 0.0 and out.count < len(out.dist):
        out.dist[out.count] = dist
        out.pos[out.count] = pos
        out.normal[out.count] = normal
        out.count += 1
    return out


@wp.func
def add_spheres(out: AnyPairContacts, a: wp.vec3, radius_a: float, b: wp.vec3, radius_b: float):
    """Return contacts with that of two spheres."""
    apart = b - a
    length = wp.length(apart)
    normal = wp.vec3(1.0, 0.0, 0.0)
    if length > 0.0:
        normal = apart / length
    dist = length - (radius_a + radius_b)
    return add_contact(out, dist, a + (radius_a + 0.5 * dist) * normal, normal)


@wp.func
def add_sphere_box(out: AnyPairContacts, centre: wp.vec3, radius: float, box: Shape):
    """Return contacts with that of a sphere and a box."""
    local = wp.transpose(box.rot) * (centre - box.pos)
    apart = wp.max(-box.size, wp.min(box.size, local)) - local
    length = wp.length(apart)
    normal = wp.vec3()
    if length > 0.0:
        normal = apart / length
    else:  # the centre is in the box: out by the nearest face
        depth = box.size - wp.abs(local)
        k = int(wp.argmin(depth))
        normal[k] = -wp.sign(local[k])
        length = -depth[k]
    dist = length - radius
    return add_contact(out, dist, centre + (radius + 0.5 * dist) * (box.rot * normal), box.rot * normal)


@wp.func
def unit(k: int) -> wp.vec3:
    """Return a unit vector along an axis."""
    out = wp.vec3()
    out[k] = 1.0
    return out


@wp.func
def axis_of(shape: Shape) -> wp.vec3:
    """Return half of a capsule's axis, from its middle to an end."""
    return shape.size[1] * column(shape.rot, 2)


@wp.func
def between_capsules(a: Shape, b: Shape) -> bool:
    """Return whether a plane across the line between two middles is between the surfaces."""
    apart, reach = b.pos - a.pos, a.size[0] + b.size[0]
    along = wp.abs(wp.dot(axis_of(a), apart)) + wp.abs(wp.dot(axis_of(b), apart))
    return wp.length_sq(apart) - along > reach * wp.length(apart)


@wp.func
def between_capsule_and_box(a: Shape, box: Shape) -> bool:
    """Return whether a plane is between the surfaces: along a face of the box, or along an edge and the axis."""
    apart, axis = wp.transpose(box.rot) * (a.pos - box.pos), wp.transpose(box.rot) * axis_of(a)
    gap = wp.max(wp.abs(apart) - wp.abs(axis) - box.size)
    for k in range(3):
        across = wp.cross(unit(k), axis)
        over_edge = wp.abs(wp.dot(across, apart)) - wp.dot(wp.abs(across), box.size)
        gap = wp.max(gap, over_edge / wp.max(wp.length(across), TINY))
    return gap > a.size[0]


@wp.func
def nearest_from(s: float, u: wp.vec3, v: wp.vec3, apart: wp.vec3) -> wp.vec2:
    """Return s and t in [-1, 1] of nearest points ``s u`` and ``apart + t v`` of two segments, from a guess of s."""
    t = (s * wp.dot(u, v) - wp.dot(v, apart)) / wp.dot(v, v)
    if wp.abs(t) > 1.0:
        t = wp.sign(t)
        s = wp.clamp((t * wp.dot(u, v) + wp.dot(u, apart)) / wp.dot(u, u), -1.0, 1.0)
    return wp.vec2(s, t)


@wp.func
def nearest_on_lines(u: wp.vec3, v: wp.vec3, apart: wp.vec3) -> wp.vec2:
    """Return s and t in [-1, 1] of the nearest points ``s u`` and ``apart + t v`` of two segments, not parallel."""
    across = wp.cross(u, v)
    s = wp.dot(across, wp.cross(apart, v)) / wp.dot(across, across)
    return nearest_from(wp.clamp(s, -1.0, 1.0), u, v, apart)


@wp.func
def are_parallel(u: wp.vec3, v: wp.vec3) -> bool:
    """Return whether two directions are the same, or opposite, up to rounding."""
    return wp.length_sq(wp.cross(u, v)) <= PARALLEL * wp.length_sq(u) * wp.length_sq(v)


@wp.func
def sphere_sphere(out: AnyPairContacts, a: Shape, b: Shape):
    """Return the contact of two spheres."""
    return add_spheres(out, a.pos, a.size[0], b.pos, b.size[0])


@wp.func
def sphere_capsule(out: AnyPairContacts, a: Shape, b: Shape):
    """Return the contact of a sphere and a capsule."""
    axis = column(b.rot, 2)
    nearest = b.pos + wp.clamp(wp.dot(axis, a.pos - b.pos), -b.size[1], b.size[1]) * axis
    return add_spheres(out, a.pos, a.size[0], nearest, b.size[0])


@wp.func
def sphere_box(out: AnyPairContacts, a: Shape, b: Shape):
    """Return the contact of a sphere and a box."""
    return add_sphere_box(out, a.pos, a.size[0], b)


@wp.func
def capsule_capsule(out: AnyPairContacts, a: Shape, b: Shape):
    """Return the contacts of two capsules: one, or one at each end of their overlap if parallel."""
    u, v, apart = axis_of(a), axis_of(b), b.pos - a.pos
    if are_parallel(u, v):
        for end in range(2):
            at = nearest_from(2.0 * float(end) - 1.0, u, v, apart)
            out = add_spheres(out, a.pos + at[0] * u, a.size[0], b.pos + at[1] * v, b.size[0])
    else:
        at = nearest_on_lines(u, v, apart)
        out = add_spheres(out, a.pos + at[0] * u, a.size[0], b.pos + at[1] * v, b.size[0])
    return out


@wp.struct
class OnBox:
    """The point of a capsule's axis that is nearest to a box."""

    along: wp.float32  # in half axes from the capsule's middle
    nearest: wp.vec3  # on the box, in its frame
    apart_sq: wp.float32  # squared distance of both
    way: wp.float32  # direction in which the capsule stays over the box: 1, -1, or 0 if in none


@wp.func
def way_over_box(half: wp.vec3, nearest: wp.vec3, size: wp.vec3) -> float:
    """Return the direction of an axis that leads over the box from the nearest point of an edge or corner, or 0.

    Of the coordinates in which the point is at the box's end, some must lead inwards and others outwards. The direction
    is the one in which more of the axis leads inwards.
    """
    lead, inwards, outwards = float(0.0), int(0), int(0)
    for k in range(3):
        if wp.abs(nearest[k]) >= size[k]:
            if (half[k] > 0.0) != (nearest[k] > 0.0):
                lead += half[k] * half[k]
                inwards += 1
            else:
                lead -= half[k] * half[k]
                outwards += 1
    return wp.where(inwards * outwards > 0, wp.where(lead > 0.0, 1.0, -1.0), 0.0)


@wp.func
def nearest_on_axis(pos: wp.vec3, half: wp.vec3, size: wp.vec3) -> OnBox:
    """Return the point of a capsule's axis that is nearest to a box: an end over or in a face, or one near an edge."""
    best = OnBox()
    best.apart_sq = NEVER
    for end in range(2):
        side = 2.0 * float(end) - 1.0
        tip = pos + side * half
        nearest = wp.max(-size, wp.min(size, tip))
        apart_sq = wp.length_sq(nearest - tip)
        outside = int(0)
        for k in range(3):
            if nearest[k] != tip[k]:
                outside += 1
                nearest[k] = -side * half[k] * NEVER  # over this face, the axis ends nowhere
        if outside <= 1 and apart_sq < best.apart_sq:
            best = OnBox(side, nearest, apart_sq, wp.where(outside == 1, -side, 0.0))
    edge = int(0)
    while edge < 12:  # not unrolled
        k, i, j = edge // 4, (edge // 4 + 1) % 3, (edge // 4 + 2) % 3
        middle, along_edge = wp.vec3(), wp.vec3()
        middle[i] = wp.where(edge % 2 == 0, -size[i], size[i])
        middle[j] = wp.where(edge % 4 < 2, -size[j], size[j])
        along_edge[k] = size[k]
        if not are_parallel(along_edge, half):
            at = nearest_on_lines(along_edge, half, pos - middle)
            nearest = middle + at[0] * along_edge
            apart_sq = wp.length_sq(pos + at[1] * half - nearest)
            if apart_sq < best.apart_sq:
                best = OnBox(at[1], nearest, apart_sq, way_over_box(half, nearest, size))
        edge += 1
    return best


@wp.func
def capsule_box(out: AnyPairContacts, a: Shape, b: Shape):
    """Return the contacts of a capsule and a box: where they are nearest, and the last point that is over the box."""
    pos, half = wp.transpose(b.rot) * (a.pos - b.pos), wp.transpose(b.rot) * axis_of(a)
    best = nearest_on_axis(pos, half, b.size)
    out = add_sphere_box(out, a.pos + best.along * axis_of(a), a.size[0], b)
    if best.way != 0.0:
        left = 1.0 - best.way * best.along
        for k in range(3):
            speed = best.way * half[k]
            until_end = (b.size[k] - wp.sign(speed) * best.nearest[k]) / wp.abs(speed)
            if until_end > 0.0:
                left = wp.min(left, until_end)
        out = add_sphere_box(out, a.pos + (best.along + best.way * left) * axis_of(a), a.size[0], b)
    return out


@wp.func
def separating_axis(number: int, rot: wp.mat33) -> wp.vec3:
    """Return one of the 15 axes along which two boxes can be apart, in the first one's frame, or 0 if it is none.

    They are the normals of the first box's faces and of the second one's, and those across an edge of each.
    """
    if number < 3:
        return unit(number)
    if number < 6:
        return column(rot, number - 3)
    across = wp.cross(unit((number - 6) // 3), column(rot, (number - 6) % 3))
    length_sq = wp.length_sq(across)
    return wp.where(length_sq < EDGE_NOISE, wp.vec3(), across / wp.sqrt(length_sq))


@wp.func
def clip(polygon: Polygon, k: int, side: float, limit: float) -> Polygon:
    """Return the part of a polygon whose coordinate ``k``, times ``side``, is up to a limit."""
    out = Polygon()
    last = polygon.corner[wp.max(polygon.count - 1, 0)]
    for i in range(polygon.count):
        corner = polygon.corner[i]
        before, after = side * last[k] - limit, side * corner[k] - limit
        if before * after < 0.0 and out.count < MAX_CORNERS:
            out.corner[out.count] = last + before / (before - after) * (corner - last)
            out.count += 1
        if after <= 0.0 and out.count < MAX_CORNERS:
            out.corner[out.count] = corner
            out.count += 1
        last = corner
    return out


@wp.func
def face_contacts(out: AnyPairContacts, a: Shape, b: Shape, f: int, sign: float):
    """Return the contacts of a face of ``a`` across its axis ``f`` with the face of ``b`` that is turned to it.

    They are the corners of that face, clipped by the sides of the first; ``sign`` is that of their normals.
    """
    x, y = (f + 1) % 3, (f + 2) % 3
    rot, apart = wp.transpose(a.rot) * b.rot, wp.transpose(a.rot) * (b.pos - a.pos)
    side = wp.where(apart[f] >= 0.0, 1.0, -1.0)
    g = int(wp.argmax(wp.abs(rot[f])))
    middle = apart - wp.sign(side * rot[f, g]) * b.size[g] * column(rot, g)
    u, v = b.size[(g + 1) % 3] * column(rot, (g + 1) % 3), b.size[(g + 2) % 3] * column(rot, (g + 2) % 3)
    face = Polygon()
    face.count = 4
    for i in range(4):
        corner = middle + wp.where(i == 0 or i == 3, 1.0, -1.0) * u + wp.where(i < 2, 1.0, -1.0) * v
        face.corner[i] = wp.vec3(corner[x], corner[y], side * corner[f] - a.size[f])  # the last one is the distance
    for i in range(4):
        face = clip(face, i // 2, wp.where(i % 2 == 0, 1.0, -1.0), wp.where(i < 2, a.size[x], a.size[y]))
    least = DUPLICATE * (a.size[x] * a.size[x] + a.size[y] * a.size[y])
    for i in range(face.count):
        corner = face.corner[i]
        is_new = bool(True)
        for j in range(i):
            other = face.corner[j] - corner
            is_new = is_new and other[0] * other[0] + other[1] * other[1] >= least
        if is_new:
            pos = wp.vec3()
            pos[x] = corner[0]
            pos[y] = corner[1]
            pos[f] = side * (a.size[f] + 0.5 * corner[2])
            out = add_contact(out, corner[2], a.pos + a.rot * pos, sign * side * column(a.rot, f))
    return out


@wp.func
def edge_contact(
    out: AnyPairContacts, a: Shape, b: Shape, i: int, j: int, axis: wp.vec3, rot: wp.mat33, apart: wp.vec3
):
    """Return the contact of two edges along the axes ``i`` and ``j`` of the boxes, across an axis from a to b."""
    u, v = a.size[i] * unit(i), b.size[j] * column(rot, j)
    turned = wp.transpose(rot) * axis
    first, second = wp.vec3(), wp.vec3()
    for k in range(3):
        if k != i:
            first[k] = wp.where(axis[k] >= 0.0, a.size[k], -a.size[k])
        if k != j:
            second[k] = wp.where(turned[k] >= 0.0, -b.size[k], b.size[k])
    second = apart + rot * second
    at = nearest_on_lines(u, v, second - first)
    first += at[0] * u
    second += at[1] * v
    dist = wp.dot(second - first, axis)
    return add_contact(out, dist, a.pos + a.rot * (0.5 * (first + second)), a.rot * axis)


@wp.func
def box_box(out: AnyPairContacts, a: Shape, b: Shape):
    """Return the contacts of two boxes: of a face, or of two edges, where they are least in each other."""
    rot, apart = wp.transpose(a.rot) * b.rot, wp.transpose(a.rot) * (b.pos - a.pos)
    slack = SLACK * (a.size[0] + a.size[1] + a.size[2] + b.size[0] + b.size[1] + b.size[2])
    face, chosen = int(0), int(0)
    of_face, best = float(-NEVER), float(-NEVER)
    number = int(0)
    while number < 15:  # not unrolled
        axis = separating_axis(number, rot)
        if wp.length_sq(axis) > 0.0:
            reach = wp.dot(a.size, wp.abs(axis)) + wp.dot(b.size, wp.abs(wp.transpose(rot) * axis))
            dist = wp.abs(wp.dot(axis, apart)) - reach
            if dist > slack:
                return out
            if number < 6 and dist > best:
                face = number
                of_face = dist
            if dist - wp.where(number < 6, 0.0, SLACK * wp.abs(dist)) > best:
                chosen = number
                best = dist
        number += 1
    axis = separating_axis(chosen, rot)
    is_like_face = wp.abs(wp.dot(axis, separating_axis(face, rot))) > LIKE_FACE
    if chosen < 6 or (is_like_face and best < of_face + BETTER * wp.abs(of_face)):
        if face < 3:
            return face_contacts(out, a, b, face, 1.0)
        return face_contacts(out, b, a, face - 3, -1.0)
    if wp.dot(axis, apart) < 0.0:
        axis = -axis
    return edge_contact(out, a, b, (chosen - 6) // 3, (chosen - 6) % 3, axis, rot, apart)
