"""Where a height map sticks into a box or a capsule between its corners or ends."""

import warp as wp

from legged_torque.sim.fused.collision import Point
from legged_torque.sim.fused.surface import SphereContacts, Surface, place_on_map, sample

STEEPEST = wp.constant(0.3)
"""Faces of a box that are turned further upwards than this, the z of their normals, push nothing out of the ground."""


@wp.func
def reach_along(turn: wp.mat33, half: wp.vec3, k: int) -> float:
    """Return how far a box with an orientation and half sizes reaches from its middle along an axis of the world."""
    return wp.abs(turn[k, 0] * half[0]) + wp.abs(turn[k, 1] * half[1]) + wp.abs(turn[k, 2] * half[2])


@wp.func
def lowest_crossing(surface: Surface, start: wp.vec3, along: wp.vec3) -> float:
    """Return how far along a line it is deepest in the ground, or least high above it, as a share of its length.

    Where the ground rises above both ends, that is on an edge between samples. The result is 0 if there are none.
    """
    place = surface.density * place_on_map(surface, start, 0.0)
    way = surface.density * along
    best, least = float(0.0), float(1.0e10)
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
            above = start[2] + share * along[2] - low - (beside - float(cell)) * (high - low)
            if above < least:
                least = above
                best = share
            line += 1
        k += 1
    return best


@wp.func
def lowest_of_capsule(surface: Surface, origin: wp.vec3, point: Point) -> wp.vec3:
    """Return the point of a capsule's axis, from the trunk's origin, that is deepest in the ground at an edge."""
    half = point.turn * point.half
    start = point.middle - half
    return start + 2.0 * lowest_crossing(surface, origin + start, 2.0 * half) * half


@wp.func
def deepest_sample(surface: Surface, origin: wp.vec3, point: Point, part: wp.vec3) -> wp.vec3:
    """Return the sample of the map that is deepest in a part of a box, in the box's axes from its middle [m].

    That is the distance to the nearest face of the box; where no sample is in the part, the result is a corner.
    """
    place = place_on_map(surface, origin + point.centre, wp.length(part))
    first, last = wp.vec2i(), wp.vec2i()
    for k in range(2):
        reach = reach_along(point.turn, part, k)
        first[k] = int(wp.ceil(surface.density * (place[k] - reach)))
        last[k] = int(wp.floor(surface.density * (place[k] + reach)))
    lowest = place[2] - reach_along(point.turn, part, 2)
    middle = wp.transpose(point.turn) * (point.centre - point.middle)
    best, most = 1.0 * point.half, float(0.0)
    i, j = first[0], first[1]
    while i <= last[0] and first[1] <= last[1]:
        height = sample(surface, i, j)
        if height > lowest:
            away = wp.vec3(float(i) * surface.scale - place[0], float(j) * surface.scale - place[1], height - place[2])
            inside = wp.transpose(point.turn) * away
            at = middle + inside
            depth = wp.min(point.half - wp.abs(at))
            if wp.min(part - wp.abs(inside)) >= 0.0 and depth > most:
                most = depth
                best = at
        j += 1
        if j > last[1]:
            j = first[1]
            i += 1
    return best


@wp.func
def touch_part(surface: Surface, origin: wp.vec3, point: Point, part: wp.vec3):
    """Return the contact of a part of a box with the sample that is deepest in it, and the point of the box there.

    It pushes through the nearest face of the box that does not face upwards, on which this point is.
    """
    touch = SphereContacts()
    at = deepest_sample(surface, origin, point, part)
    least = float(1.0e10)
    for k in range(3):
        for side in range(2):
            sign = 1.0 - 2.0 * float(side)
            depth = point.half[k] - sign * at[k]
            if depth < least and sign * point.turn[2, k] < STEEPEST:
                least = depth
                touch.first = -sign * wp.vec3(point.turn[0, k], point.turn[1, k], point.turn[2, k])
    touch.dist[0] = -least
    touch.count = wp.where(wp.min(point.half - wp.abs(at)) > 0.0, 1, 0)
    return touch, point.middle + point.turn * at - least * touch.first
