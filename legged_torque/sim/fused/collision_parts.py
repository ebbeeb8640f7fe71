"""Where a height map sticks into a box or a capsule between its corners or ends."""

import warp as wp

from legged_torque.sim.fused.collision import Point
from legged_torque.sim.fused.surface import FAR_AWAY, SphereContacts, Surface, height_at, load_row, place_on_map, sample

UPWARDS = wp.constant(0.5)
"""Nothing leaves the ground through a face of a box whose normal's z is greater: it looks up by over 30 degrees."""

MOST_CLEARANCE = wp.constant(2.0)
"""An axis this many radii above the ground, vertically, does not touch it: slopes are less steep than 60 degrees."""


@wp.func
def reach_along(turn: wp.mat33, half: wp.vec3, k: int) -> float:
    """Return how far a box with an orientation and half sizes reaches from its middle along an axis of the world."""
    return wp.abs(turn[k, 0] * half[0]) + wp.abs(turn[k, 1] * half[1]) + wp.abs(turn[k, 2] * half[2])


@wp.func
def lowest_of_capsule(surface: Surface, origin: wp.vec3, point: Point, part: wp.vec3):
    """Return whether the axis of a part of a capsule is lowest above the ground, or deepest in it, between its ends.

    Also that place, from the trunk's origin: there the axis crosses an edge of two triangles. Places that are too high
    to touch do not count.
    """
    along = 2.0 * (point.turn * part)
    start = point.centre - 0.5 * along
    first = place_on_map(surface, origin + start, 0.0)
    place, way = surface.density * first, surface.density * along
    ends = wp.min(first[2] - height_at(surface, place), first[2] + along[2] - height_at(surface, place + way))
    best, least = float(-1.0), wp.min(ends, MOST_CLEARANCE * point.radius)
    k = int(0)  # edges of one x, of one y, diagonals; not unrolled, as in nearest_point
    while k < 3:
        at = wp.where(k == 0, place[0], wp.where(k == 1, place[1], place[0] - place[1]))
        rate = wp.where(k == 0, way[0], wp.where(k == 1, way[1], way[0] - way[1]))
        line = int(wp.floor(wp.min(at, at + rate))) + 1
        while line <= int(wp.floor(wp.max(at, at + rate))):
            share = (float(line) - at) / rate
            beside = wp.where(k == 0, place[1] + share * way[1], place[0] + share * way[0])
            cell = int(wp.floor(beside))
            i = wp.where(k == 0, line, cell)
            j = wp.where(k == 0, cell, wp.where(k == 1, line, cell - line))
            low, high = sample(surface, i, j), sample(surface, i + wp.min(k, 1), j + wp.where(k == 1, 0, 1))
            above = first[2] + share * along[2] - low - (beside - float(cell)) * (high - low)
            if above < least:
                least = above
                best = share
            line += 1
        k += 1
    return best >= 0.0, start + best * along


@wp.func
def way_out(point: Point, place: wp.vec3) -> wp.vec3:
    """Return the shortest way from a place in a box to a face that does not look up, in the box's axes from its middle.

    From a place outside of the box it leads back to the face.
    """
    least = float(FAR_AWAY)
    way = wp.vec3()
    for k in range(3):
        side = wp.where(place[k] < 0.0, -1.0, 1.0)
        side = wp.where(side * point.turn[2, k] > UPWARDS, -side, side)
        depth = point.half[k] - side * place[k]
        if depth < least:
            least = depth
            way = wp.vec3()
            way[k] = side * depth
    return way


@wp.func
def touch_part(surface: Surface, origin: wp.vec3, point: Point, part: wp.vec3):
    """Return the contact of a part of a box with the sample of the map that is deepest in it, and its point of the box.

    A sample pushes through the face that is nearest to it.
    """
    touch = SphereContacts()
    middle = point.centre - point.middle
    place = place_on_map(surface, origin + point.centre, wp.length(part))
    reach = wp.vec3(
        reach_along(point.turn, part, 0), reach_along(point.turn, part, 1), reach_along(point.turn, part, 2)
    )
    first, last = surface.density * (place - reach), surface.density * (place + reach)
    from_box = wp.vec3()
    i, j = int(wp.ceil(first[0])), int(wp.ceil(first[1]))
    while i <= int(wp.floor(last[0])) and wp.ceil(first[1]) <= last[1]:
        row = load_row(surface, i, j)  # three at once: a thread waits for each access to memory
        b = wp.where(wp.max(row) > place[2] - reach[2], 0, 3)
        while b < 3:
            height = wp.where(b == 0, row[0], wp.where(b == 1, row[1], row[2]))
            arm = wp.vec3(float(i) * surface.scale, float(j + b) * surface.scale, height) - place
            in_box = wp.transpose(point.turn) * (middle + arm)
            way = point.turn * way_out(point, in_box)
            is_inside = wp.min(part - wp.abs(wp.transpose(point.turn) * arm)) > 0.0
            if is_inside and wp.length(way) > -touch.dist[0]:
                touch.count = 1
                touch.dist[0] = -wp.length(way)
                touch.first = way / touch.dist[0]
                from_box = middle + arm + way
            b += 1
        j += 3
        if j > int(wp.floor(last[1])):
            j = int(wp.ceil(first[1]))
            i += 1
    return touch, point.middle + from_box
