"""The surface of a height map, two triangles per cell, and where a sphere touches it."""

import math

import numpy as np
import warp as wp

from legged_torque.sim.fused.math import inverse_sqrt
from legged_torque.sim.height_map import HeightMap

NEAR, FAR = 0.05, 0.2
"""Spheres up to the first size, and geoms up to the second [m], that are high enough above the ground are known to be
so from one number."""
BLOCK = wp.constant(2)
"""Cells along a side of what shares such a number for geoms."""
MAX_REACH = wp.constant(0.2)
"""How far around the centre of a sphere that is below the surface the way out is looked for [m]."""
ALIKE = wp.constant(0.999)
"""Faces whose normals have this cosine, 2.6 degrees, are one face: a sphere never touches both."""
ON_EDGE = wp.constant(1.0e-5)
"""A point this share of a triangle's height outside of it is still inside, so that rounding leaves no gaps."""
MIN_DISTANCE = wp.constant(1.0e-6)
"""A direction over a shorter way [m] is lost in float32."""
FAR_AWAY = wp.constant(1.0e10)
"""Squared distance of what has not been found [m^2]."""


@wp.struct
class Surface:
    """Heights on a square grid, continued at the borders with the heights there."""

    heights: wp.array2d(dtype=wp.float32)  # in the world [m]. Shape: (rows, cols); rows along x, columns along y
    scale: wp.float32  # side of a cell [m]
    corner: wp.vec2  # x and y of the first height [m]
    ceiling: wp.array2d(dtype=wp.float32)  # the greatest height near each cell [m]. Shape: (rows - 1, cols - 1)
    near: wp.float32  # how far around a cell that is [m]
    far_ceiling: wp.array2d(dtype=wp.float32)  # the greatest height in a wider neighbourhood of each block of cells [m]
    far: wp.float32  # how far around a block that is [m]


def make_surface(height_map: HeightMap) -> Surface:
    """Return a height map on the current device."""
    heights, scale = np.asarray(height_map.heights, np.float32), height_map.horizontal_scale
    near, far = math.ceil(NEAR / scale), math.ceil(FAR / scale)
    surface = Surface()
    surface.heights = wp.array(heights, dtype=wp.float32)
    surface.scale = scale
    surface.corner = wp.vec2(*height_map.corner)
    surface.ceiling = wp.array(_greatest(heights, 1, near), dtype=wp.float32)
    surface.near = near * scale
    surface.far_ceiling = wp.array(_greatest(heights, BLOCK, far), dtype=wp.float32)
    surface.far = far * scale
    return surface


def _greatest(heights: np.ndarray, side: int, around: int) -> np.ndarray:
    """Return the greatest height in each square of so many cells a side, and in so many cells around it."""
    for _ in range(2):  # along one axis after the other
        squares = -(-(len(heights) - 1) // side)
        padded = np.pad(heights, ((around, around + side), (0, 0)), "edge")
        ends = range(side + 2 * around + 1)
        heights = np.maximum.reduce([padded[i : i + squares * side : side] for i in ends]).T
    return heights


@wp.struct
class Touch:
    """The point of the surface that is nearest to the centre of a sphere, and a second one in a concave edge."""

    count: wp.int32  # how many of the two touch
    dist: wp.vec2  # distances between the surface and the sphere [m], negative where they overlap
    first: wp.vec3  # unit normals, towards the sphere
    second: wp.vec3


@wp.struct
class Patch:
    """Four cells of a map as seen from the centre of a sphere: their nine samples."""

    x: wp.vec3  # of the three rows
    y: wp.vec3  # of the three columns
    z: wp.mat33
    scale: wp.float32  # side of a cell [m]


@wp.struct
class Face:
    """A triangle as seen from the centre of a sphere."""

    nearest: wp.vec3  # the point of its plane that is nearest to the centre
    is_inside: wp.bool  # whether that is inside of the triangle
    normal: wp.vec3  # upwards
    above: wp.float32  # how far the centre is above its plane, vertically [m]
    dist: wp.float32  # the same along the normal


@wp.struct
class Nearest:
    """The point of the surface that is nearest to the centre of a sphere, as far as it has been looked at."""

    point: wp.vec3  # from the centre
    away_sq: wp.float32  # its squared distance from there
    is_face: wp.bool  # whether it is inside of a triangle, not on an edge or at a vertex
    normal: wp.vec3  # of a face, upwards: of this one if it is one
    dist: wp.float32  # of the centre above that face, else 0
    above: wp.float32  # how far the centre is above the surface, vertically [m]
    other: wp.vec3  # the normal of one of the faces that the sphere touches; 0 if there is none
    is_mixed: wp.bool  # whether it touches faces that are not like that one


@wp.func
def place_on_map(surface: Surface, centre: wp.vec3, radius: float) -> wp.vec3:
    """Return the centre of a sphere from the map's corner, in x and y.

    Outside of the map all is flat outwards: a place further out is like one near the border.
    """
    place = centre
    margin = wp.max(radius, MAX_REACH) + 2.0 * surface.scale
    for k in range(2):
        end = float(surface.heights.shape[k] - 1) * surface.scale
        place[k] = wp.clamp(centre[k] - surface.corner[k], -margin, end + margin)
    return place


@wp.func
def see_patch(surface: Surface, place: wp.vec3, i: int, j: int) -> Patch:
    """Return the four cells between samples (i, j) and (i + 2, j + 2) as seen from a place on the map."""
    last_row, last_col = surface.heights.shape[0] - 1, surface.heights.shape[1] - 1
    x, y = float(i) * surface.scale - place[0], float(j) * surface.scale - place[1]
    patch = Patch()
    patch.scale = surface.scale
    for a in range(3):
        patch.x[a] = x + float(a) * surface.scale
        patch.y[a] = y + float(a) * surface.scale
        for b in range(3):
            patch.z[a, b] = surface.heights[wp.clamp(i + a, 0, last_row), wp.clamp(j + b, 0, last_col)] - place[2]
    return patch


@wp.func
def see_face(patch: Patch, a: int, b: int, half: int) -> Face:
    """Return one of the two triangles of a cell (a, b) of a patch.

    The diagonal runs from a cell's corner (0, 0) to (1, 1); the half 0 has the corner (1, 0).
    """
    falls = wp.vec2(patch.z[a, b] - patch.z[a + 1, b], patch.z[a + 1, b] - patch.z[a + 1, b + 1])
    if half == 1:
        falls = wp.vec2(patch.z[a, b + 1] - patch.z[a + 1, b + 1], patch.z[a, b] - patch.z[a, b + 1])
    falls = falls / patch.scale
    face = Face()
    face.above = -(patch.z[a, b] + falls[0] * patch.x[a] + falls[1] * patch.y[b])
    face.normal = inverse_sqrt(1.0 + wp.length_sq(falls)) * wp.vec3(falls[0], falls[1], 1.0)
    face.dist = face.above * face.normal[2]
    face.nearest = -face.dist * face.normal
    u, v = face.nearest[0] - patch.x[a], face.nearest[1] - patch.y[b]
    long, short = wp.where(half == 0, u, v), wp.where(half == 0, v, u)
    face.is_inside = wp.min(patch.scale - long, wp.min(long - short, short)) >= -ON_EDGE * patch.scale
    return face


@wp.func
def is_under(patch: Patch, a: int, b: int, half: int) -> bool:
    """Return whether the centre is vertically over, or under, a triangle of a patch."""
    in_cell = patch.x[a] <= 0.0 and patch.x[a + 1] > 0.0 and patch.y[b] <= 0.0 and patch.y[b + 1] > 0.0
    return in_cell and (half == 0) == (patch.x[a] <= patch.y[b])


@wp.func
def look_at_faces(patch: Patch, radius: float, best: Nearest) -> Nearest:
    """Return what is nearest when a patch's triangles are known, without their edges; a face wins among equals."""
    for a in range(2):
        for b in range(2):
            for half in range(2):
                face = see_face(patch, a, b, half)
                if is_under(patch, a, b, half):
                    best.above = face.above
                if face.is_inside:
                    away_sq = face.dist * face.dist
                    if wp.where(best.is_face, 1.0, 1.0 - ON_EDGE) * away_sq < best.away_sq:
                        best.point = face.nearest
                        best.away_sq = away_sq
                        best.is_face = True
                        best.normal = face.normal
                        best.dist = face.dist
                    if face.dist < radius:
                        is_known = wp.length_sq(best.other) > 0.0
                        if is_known and wp.dot(face.normal, best.other) < ALIKE:
                            best.is_mixed = True
                        best.other = face.normal
    return best


@wp.func
def look_at_edge(patch: Patch, a: int, b: int, c: int, d: int, best: Nearest) -> Nearest:
    """Return what is nearest when the edge between two samples of a patch is known."""
    start = wp.vec3(patch.x[a], patch.y[b], patch.z[a, b])
    edge = wp.vec3(patch.x[c], patch.y[d], patch.z[c, d]) - start
    point = start + wp.clamp(-wp.dot(start, edge) / wp.length_sq(edge), 0.0, 1.0) * edge
    away_sq = wp.length_sq(point)
    if wp.where(best.is_face, 1.0 + ON_EDGE, 1.0) * away_sq < best.away_sq:
        best.point = point
        best.away_sq = away_sq
        best.is_face = False
        best.dist = 0.0
    return best


@wp.func
def look_at_edges(patch: Patch, best: Nearest) -> Nearest:
    """Return what is nearest when a patch's edges are known."""
    for a in range(3):
        for b in range(2):
            best = look_at_edge(patch, a, b, a, b + 1, best)
            best = look_at_edge(patch, b, a, b + 1, a, best)
    for a in range(2):
        for b in range(2):
            best = look_at_edge(patch, a, b, a + 1, b + 1, best)
    return best


@wp.func
def distance_sq_to_patch(patch: Patch) -> float:
    """Return the squared distance from the centre to a patch, filled up to its highest sample."""
    top = patch.z[0, 0]
    for a in range(3):
        for b in range(3):
            top = wp.max(top, patch.z[a, b])
    x, y = wp.max(patch.x[0], -patch.x[2]), wp.max(patch.y[0], -patch.y[2])
    return wp.length_sq(wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(-top, 0.0)))


@wp.struct
class Window:
    """The patches of a map that a sphere may touch: the one around its centre, and if it is large, those around."""

    middle: wp.vec2i  # the first samples of that one
    first: wp.vec2i  # of the others
    cols: wp.int32  # how many of them along y
    count: wp.int32  # of all


@wp.func
def make_window(surface: Surface, place: wp.vec3, reach: float) -> Window:
    """Return the patches within a distance along x and y of a place on the map."""
    window = Window()
    count = int(1)
    for k in range(2):
        window.middle[k] = int(wp.floor(place[k] / surface.scale - 0.5))
        window.first[k] = int(wp.floor((place[k] - reach) / surface.scale))
        window.cols = (int(wp.floor((place[k] + reach) / surface.scale)) - window.first[k]) // 2 + 1
        count *= window.cols
    window.count = wp.where(reach > 0.5 * surface.scale, 1 + count, 1)
    return window


@wp.func
def patch_of_window(surface: Surface, place: wp.vec3, window: Window, k: int) -> Patch:
    """Return one of a window's patches."""
    i, j = window.middle[0], window.middle[1]
    if k > 0:
        i, j = window.first[0] + 2 * ((k - 1) // window.cols), window.first[1] + 2 * ((k - 1) % window.cols)
    return see_patch(surface, place, i, j)


@wp.func
def find_nearest(surface: Surface, place: wp.vec3, radius: float) -> Nearest:
    """Return the point of the surface that is nearest to the centre of a sphere.

    The way out of the ground is as far as the centre is below it, vertically, or shorter.
    """
    best = Nearest()
    best.away_sq = FAR_AWAY
    best.normal = wp.vec3(0.0, 0.0, 1.0)
    window = make_window(surface, place, radius)
    k = int(0)
    while k < window.count:
        patch = patch_of_window(surface, place, window, k)
        if k == 0 or distance_sq_to_patch(patch) < (1.0 + ON_EDGE) * wp.max(best.away_sq, radius * radius):
            best = look_at_faces(patch, radius, best)
            best = look_at_edges(patch, best)
        if k == 0 and -best.above > radius:
            window = make_window(surface, place, wp.min(-best.above, MAX_REACH))
        k += 1
    return best


@wp.func
def second_face(surface: Surface, place: wp.vec3, radius: float, point: wp.vec3, normal: wp.vec3) -> Face:
    """Return the deepest other face that a sphere touches at a concave edge, given where it touches the surface.

    Both points are in front of the other's face. One at the distance of the radius if there is none.
    """
    best = Face()
    best.dist = radius
    window = make_window(surface, place, radius)
    for k in range(window.count):
        patch = patch_of_window(surface, place, window, k)
        for a in range(2):
            for b in range(2):
                for half in range(2):
                    other = see_face(patch, a, b, half)
                    if other.is_inside and other.dist < best.dist and wp.dot(normal, other.normal) < ALIKE:
                        way = other.nearest - point
                        if wp.min(wp.dot(way, normal), -wp.dot(way, other.normal)) > 10.0 * MIN_DISTANCE:
                            best = other
    return best


@wp.func
def is_clear(surface: Surface, centre: wp.vec3, lowest: float, radius: float) -> bool:
    """Return whether what is within a radius along x and y of a point is above all that is near.

    ``lowest`` is the height of its lowest point. That is all that most points and geoms need to know.
    """
    i = int(wp.clamp((centre[0] - surface.corner[0]) / surface.scale, 0.0, float(surface.ceiling.shape[0] - 1)))
    j = int(wp.clamp((centre[1] - surface.corner[1]) / surface.scale, 0.0, float(surface.ceiling.shape[1] - 1)))
    out = bool(False)
    if radius <= surface.near:
        out = lowest > surface.ceiling[i, j]
    elif radius <= surface.far:
        out = lowest > surface.far_ceiling[i // BLOCK, j // BLOCK]
    return out


@wp.func
def touch_map(surface: Surface, centre: wp.vec3, radius: float) -> Touch:
    """Return where a sphere touches the surface.

    The nearest point of the whole surface is one of a face, or of an edge or vertex that sticks out: edges between
    triangles of one plane are never felt. Of a sphere whose centre is below the surface it is the shortest way out.
    """
    out = Touch()
    place = place_on_map(surface, centre, radius)
    nearest = find_nearest(surface, place, radius)
    away = wp.sqrt(nearest.away_sq)
    out.first = nearest.normal
    out.dist[0] = nearest.dist - radius
    if not nearest.is_face and away > MIN_DISTANCE:
        side = wp.where(nearest.above < 0.0, 1.0, -1.0)
        out.first = side * nearest.point / away
        out.dist[0] = -side * away - radius
    if out.dist[0] < 0.0:
        out.count = 1
        is_other = wp.length_sq(nearest.other) > 0.0 and wp.dot(nearest.other, out.first) < ALIKE
        if nearest.is_mixed or is_other:
            other = second_face(surface, place, radius, nearest.point, out.first)
            if other.dist < radius:
                out.count = 2
                out.second = other.normal
                out.dist[1] = other.dist - radius
    return out
