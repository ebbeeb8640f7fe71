"""The surface of a height map, two triangles per cell, and its contacts with a sphere."""

import functools
import math

import numpy as np
import warp as wp

from legged_torque.sim.engine import HeightMap
from legged_torque.sim.fused.math import inverse_sqrt

NEAR, MIDDLE, FAR = 0.05, 0.1, 0.2
"""What reaches as far along x and y [m] is known to be clear of the ground from one number."""
BLOCK = wp.constant(2)
"""Cells along a side of a block that shares such a number for the larger two."""
MAX_REACH = wp.constant(0.2)
"""Range in which the shortest way out is searched for a sphere whose centre is below the surface [m]."""
ALIKE = wp.constant(0.999)
"""Faces whose normals have this cosine, 2.6 degrees, are one face: a sphere never touches both."""
ON_EDGE = wp.constant(1.0e-5)
"""A point this share of a triangle's height outside of it is still inside, so that rounding leaves no gaps."""
MIN_DISTANCE = wp.constant(1.0e-6)
"""A direction over a shorter way [m] is lost in float32."""
FAR_AWAY = wp.constant(1.0e10)
"""Squared distance of a feature that has not been found [m^2]."""


@wp.struct
class Surface:
    """Heights on a square grid, extended beyond the borders at the same heights."""

    heights: wp.array(dtype=wp.float32)  # in the world [m], row by row; rows along x, columns along y
    shape: wp.vec2i  # rows and columns
    scale: wp.float32  # side of a cell [m]
    density: wp.float32  # cells per metre
    corner: wp.vec2  # x and y of the first height [m]
    ceiling: wp.array2d(dtype=wp.float32)  # the greatest height near each cell [m]. Shape: (rows - 1, cols - 1)
    near: wp.float32  # radius of that neighbourhood [m]
    middle_ceiling: wp.array2d(dtype=wp.float32)  # the greatest height around each block of cells [m]
    middle: wp.float32
    far_ceiling: wp.array2d(dtype=wp.float32)
    far: wp.float32


def make_surface(height_map: HeightMap) -> Surface:
    """Return a height map on the current device."""
    heights, scale = np.asarray(height_map.heights, np.float32), height_map.horizontal_scale
    near, middle, far = (math.ceil(reach / scale) for reach in (NEAR, MIDDLE, FAR))
    surface = Surface()
    surface.heights = wp.array(heights.flatten(), dtype=wp.float32)
    surface.shape = wp.vec2i(*heights.shape)
    surface.scale = scale
    surface.density = 1.0 / scale
    surface.corner = wp.vec2(*height_map.corner)
    surface.ceiling = wp.array(_greatest(heights, 1, near), dtype=wp.float32)
    surface.near = near * scale
    surface.middle_ceiling = wp.array(_greatest(heights, BLOCK, middle), dtype=wp.float32)
    surface.middle = middle * scale
    surface.far_ceiling = wp.array(_greatest(heights, BLOCK, far), dtype=wp.float32)
    surface.far = far * scale
    return surface


def _greatest(heights: np.ndarray, side: int, around: int) -> np.ndarray:
    """Return the greatest height in each square of so many cells a side, and in so many cells around it."""
    for _ in range(2):  # along one axis after the other
        squares = -(-(len(heights) - 1) // side)
        padded = np.pad(heights, ((around, around + side), (0, 0)), "edge")
        ends = range(side + 2 * around + 1)
        heights = functools.reduce(np.maximum, (padded[i : i + squares * side : side] for i in ends)).T
    return heights


@wp.struct
class SphereContacts:
    """Contacts of a sphere: the nearest point of the surface, and a second one in a concave edge."""

    count: wp.int32  # 0, 1 or 2
    dist: wp.vec2  # distances between the surface and the sphere [m], negative where they overlap
    first: wp.vec3  # unit normals, towards the sphere
    second: wp.vec3


@wp.struct
class Patch:
    """Nine samples of a map, the corners of four cells, relative to the centre of a sphere."""

    x: wp.float32  # of the first row
    y: wp.vec3  # of the three columns
    z: wp.float32  # of the centre, in the world
    first: wp.vec3  # heights of the rows, in the world
    second: wp.vec3
    third: wp.vec3


@wp.struct
class Face:
    """A triangle relative to the centre of a sphere."""

    falls: wp.vec2  # descent along x and y, per metre
    upright: wp.float32  # its upward unit normal is this times (falls, 1)
    dist: wp.float32  # of the centre above its plane [m]
    is_inside: wp.bool  # whether the point of its plane that is nearest to the centre is inside of it


@wp.struct
class Nearest:
    """The nearest face and edge to the centre of a sphere, among those seen so far."""

    face: Face  # of the triangles, where it is inside of one
    face_sq: wp.float32  # its squared distance
    edge: wp.vec3  # of the edges, the point from the centre
    edge_sq: wp.float32  # its squared distance
    above: wp.float32  # how far the centre is above the surface, vertically [m]
    num_faces: wp.int32  # number of triangles that the sphere touches inside of them


@wp.func
def place_on_map(surface: Surface, centre: wp.vec3, radius: float) -> wp.vec3:
    """Return the centre of a sphere from the map's corner, in x and y.

    Outside of the map all is flat outwards: a place further out is like one near the border.
    """
    place = centre
    margin = wp.max(radius, MAX_REACH) + 2.0 * surface.scale
    for k in range(2):
        end = float(surface.shape[k] - 1) * surface.scale
        place[k] = wp.clamp(centre[k] - surface.corner[k], -margin, end + margin)
    return place


@wp.func
def sample(surface: Surface, i: int, j: int) -> float:
    """Return the height of a sample, or of the nearest one for places outside of the map."""
    row = wp.clamp(i, 0, surface.shape[0] - 1) * surface.shape[1]
    return surface.heights[row + wp.clamp(j, 0, surface.shape[1] - 1)]


@wp.func
def height_at(surface: Surface, place: wp.vec3) -> float:
    """Return the height of the surface at a place on the map, whose x and y are in cells from its corner."""
    i, j = int(wp.floor(place[0])), int(wp.floor(place[1]))
    x, y = place[0] - float(i), place[1] - float(j)
    low, high = sample(surface, i, j), sample(surface, i + 1, j + 1)
    third = sample(surface, i + wp.where(x >= y, 1, 0), j + wp.where(x >= y, 0, 1))
    return low + wp.max(x, y) * (third - low) + wp.min(x, y) * (high - third)


@wp.func
def load_row(surface: Surface, i: int, j: int) -> wp.vec3:
    """Return the heights of three samples of a row from (i, j) on."""
    return wp.vec3(sample(surface, i, j), sample(surface, i, j + 1), sample(surface, i, j + 2))


@wp.func
def load_patch(surface: Surface, place: wp.vec3, i: int, j: int) -> Patch:
    """Return the four cells between samples (i, j) and (i + 2, j + 2), relative to a place on the map."""
    patch = Patch()
    patch.x = float(i) * surface.scale - place[0]
    patch.z = place[2]
    y = float(j) * surface.scale - place[1]
    patch.y = wp.vec3(y, y + surface.scale, y + 2.0 * surface.scale)
    patch.first = load_row(surface, i, j)
    patch.second = load_row(surface, i + 1, j)
    patch.third = load_row(surface, i + 2, j)
    return patch


@wp.func
def next_row(patch: Patch, scale: float) -> Patch:
    """Return a patch whose first row is another one's second."""
    patch.x += scale
    patch.first = patch.second
    patch.second = patch.third
    return patch


@wp.func
def make_face(surface: Surface, patch: Patch, b: int, half: int) -> Face:
    """Return one of the two triangles of a cell of a patch's first two rows.

    The diagonal runs from a cell's corner (0, 0) to (1, 1); the half 0 has the corner (1, 0).
    """
    falls = wp.vec2(patch.first[b] - patch.second[b], patch.second[b] - patch.second[b + 1])
    if half == 1:
        falls = wp.vec2(patch.first[b + 1] - patch.second[b + 1], patch.first[b] - patch.first[b + 1])
    face = Face()
    face.falls = surface.density * falls
    face.upright = inverse_sqrt(1.0 + wp.length_sq(face.falls))
    above = patch.z - patch.first[b] - (face.falls[0] * patch.x + face.falls[1] * patch.y[b])
    face.dist = above * face.upright
    sideways = -(face.dist * face.upright) * face.falls
    u, v = sideways[0] - patch.x, sideways[1] - patch.y[b]
    long, short = wp.where(half == 0, u, v), wp.where(half == 0, v, u)
    face.is_inside = wp.min(surface.scale - long, wp.min(long - short, short)) >= -ON_EDGE * surface.scale
    return face


@wp.func
def normal_of(face: Face) -> wp.vec3:
    """Return a triangle's upward unit normal."""
    return face.upright * wp.vec3(face.falls[0], face.falls[1], 1.0)


@wp.func
def nearest_on_face(face: Face, radius: float, best: Nearest) -> Nearest:
    """Update the nearest features with a triangle, without its edges."""
    away_sq = wp.where(face.is_inside, face.dist * face.dist, FAR_AWAY)
    if away_sq < best.face_sq:
        best.face_sq = away_sq
        best.face = face
    best.num_faces += wp.where(wp.where(face.is_inside, face.dist, FAR_AWAY) < radius, 1, 0)
    return best


@wp.func
def nearest_on_edge(start: wp.vec3, edge: wp.vec3, best: Nearest) -> Nearest:
    """Update the nearest features with an edge between two samples."""
    point = start + wp.clamp(-wp.dot(start, edge) / wp.length_sq(edge), 0.0, 1.0) * edge
    away_sq = wp.length_sq(point)
    if away_sq < best.edge_sq:
        best.edge_sq = away_sq
        best.edge = point
    return best


@wp.func
def nearest_on_cells(surface: Surface, patch: Patch, radius: float, best: Nearest) -> Nearest:
    """Update the nearest features with the two cells of a patch's first two rows.

    A cell has three edges here: the other two belong to its neighbours.
    """
    for b in range(2):
        for half in range(2):
            best = nearest_on_face(make_face(surface, patch, b, half), radius, best)
        start, z = wp.vec3(patch.x, patch.y[b], patch.first[b] - patch.z), patch.first[b]
        best = nearest_on_edge(start, wp.vec3(surface.scale, 0.0, patch.second[b] - z), best)
        best = nearest_on_edge(start, wp.vec3(0.0, surface.scale, patch.first[b + 1] - z), best)
        best = nearest_on_edge(start, wp.vec3(surface.scale, surface.scale, patch.second[b + 1] - z), best)
    return best


@wp.func
def height_above(surface: Surface, patch: Patch) -> float:
    """Return the vertical height of a sphere's centre above the surface, if it is over the patch [m]."""
    if patch.x + surface.scale <= 0.0:
        patch = next_row(patch, surface.scale)
    is_second = patch.y[1] <= 0.0
    low = wp.where(is_second, patch.first[1], patch.first[0])
    along_x = wp.where(is_second, patch.second[1], patch.second[0])
    along_y = wp.where(is_second, patch.first[2], patch.first[1])
    high = wp.where(is_second, patch.second[2], patch.second[1])
    x, y = -surface.density * patch.x, -surface.density * wp.where(is_second, patch.y[1], patch.y[0])
    third = wp.where(x >= y, along_x, along_y)
    return patch.z - low - (wp.max(x, y) * (third - low) + wp.min(x, y) * (high - third))


@wp.func
def distance_sq_to_patch(patch: Patch, scale: float) -> float:
    """Return the squared distance from the centre to the box below a patch's highest sample."""
    top = wp.max(wp.max(wp.max(patch.first), wp.max(patch.second)), wp.max(patch.third))
    x, y = wp.max(patch.x, -patch.x - 2.0 * scale), wp.max(patch.y[0], -patch.y[2])
    return wp.length_sq(wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(patch.z - top, 0.0)))


@wp.struct
class Window:
    """The patches of a map that a sphere may touch, by their first samples."""

    first: wp.vec2i
    last: wp.vec2i


@wp.func
def make_window(surface: Surface, place: wp.vec3, reach: float) -> Window:
    """Return the patches within a distance along x and y of a place on the map: one up to half a cell."""
    cells = reach * surface.density
    window = Window()
    for k in range(2):
        at = place[k] * surface.density
        window.first[k] = int(wp.floor(at - wp.max(cells, 0.5)))
        window.last[k] = wp.where(cells > 0.5, int(wp.floor(at + cells)), window.first[k])
    return window


@wp.func
def nearest_point(surface: Surface, place: wp.vec3, radius: float) -> Nearest:
    """Return the nearest features to the centre of a sphere.

    The shortest way out of the ground is not longer than the vertical one.
    """
    best = Nearest()
    best.face_sq = FAR_AWAY
    best.edge_sq = FAR_AWAY
    window = make_window(surface, place, 0.0)
    i, j = window.first[0], window.first[1]
    is_first = bool(True)
    while i <= window.last[0]:
        patch = load_patch(surface, place, i, j)
        reach = float(0.0)
        if is_first:
            best.above = height_above(surface, patch)
            reach = wp.max(radius, wp.min(-best.above, MAX_REACH))
        most_sq = wp.max(radius * radius, wp.min(best.face_sq, best.edge_sq))
        rows = wp.where(distance_sq_to_patch(patch, surface.scale) <= (1.0 + ON_EDGE) * most_sq, 2, 0)
        while rows > 0:  # not unrolled: a thread waits for instructions longer than it works on them
            best = nearest_on_cells(surface, patch, radius, best)
            patch = next_row(patch, surface.scale)
            rows -= 1
        is_first = False
        j += 2
        if j > window.last[1]:
            j = window.first[1]
            i += 2
        if reach > 0.5 * surface.scale:  # one patch is not enough
            window = make_window(surface, place, reach)
            i = window.first[0]
            j = window.first[1]
    return best


@wp.func
def second_face(surface: Surface, place: wp.vec3, radius: float, point: wp.vec3, normal: wp.vec3) -> Face:
    """Return the deepest other face that a sphere touches at a concave edge, besides a point with a normal.

    Each of the two points is in front of the other's face. If there is none, the result has the radius as distance.
    """
    best = Face()
    best.dist = radius
    window = make_window(surface, place, radius)
    for i in range(window.first[0], window.last[0] + 1, 2):
        for j in range(window.first[1], window.last[1] + 1, 2):
            patch = load_patch(surface, place, i, j)
            rows = int(2)
            while rows > 0:
                for b in range(2):
                    for half in range(2):
                        other = make_face(surface, patch, b, half)
                        other_normal = normal_of(other)
                        way = -other.dist * other_normal - point
                        is_concave = wp.min(wp.dot(way, normal), -wp.dot(way, other_normal)) > 10.0 * MIN_DISTANCE
                        is_new = is_concave and wp.dot(normal, other_normal) < ALIKE
                        if is_new and other.is_inside and other.dist < best.dist:
                            best = other
                patch = next_row(patch, surface.scale)
                rows -= 1
    return best


@wp.func
def is_clear(surface: Surface, centre: wp.vec3, lowest: float, radius: float) -> bool:
    """Return whether a body within a radius along x and y of a point is known to be above the ground.

    ``lowest`` is the height of its lowest point. Most points and geoms need no other test.
    """
    i = int(wp.clamp((centre[0] - surface.corner[0]) * surface.density, 0.0, float(surface.ceiling.shape[0] - 1)))
    j = int(wp.clamp((centre[1] - surface.corner[1]) * surface.density, 0.0, float(surface.ceiling.shape[1] - 1)))
    out = bool(False)
    if radius <= surface.near:
        out = lowest > surface.ceiling[i, j]
    elif radius <= surface.middle:
        out = lowest > surface.middle_ceiling[i // BLOCK, j // BLOCK]
    elif radius <= surface.far:
        out = lowest > surface.far_ceiling[i // BLOCK, j // BLOCK]
    return out


@wp.func
def sphere_map(surface: Surface, centre: wp.vec3, radius: float) -> SphereContacts:
    """Return the contacts of a sphere with the surface.

    The nearest point of the whole surface is on a face, or on an edge or vertex that sticks out: edges between
    triangles of one plane have no effect. For a centre below the surface it is the shortest way out.
    """
    out = SphereContacts()
    place = place_on_map(surface, centre, radius)
    nearest = nearest_point(surface, place, radius)
    away = wp.sqrt(nearest.edge_sq)
    is_face = wp.sqrt(nearest.face_sq) < away + MIN_DISTANCE  # of equals the face: it has the better normal
    out.first = normal_of(nearest.face)
    out.dist[0] = nearest.face.dist - radius
    point = -nearest.face.dist * out.first
    if not is_face:
        point = nearest.edge
        side = wp.where(nearest.above < 0.0, 1.0, -1.0)
        out.first = wp.where(away > MIN_DISTANCE, side / away * point, wp.vec3(0.0, 0.0, 1.0))
        out.dist[0] = -side * away - radius
    if out.dist[0] < 0.0:
        out.count = 1
        if nearest.num_faces > wp.where(is_face, 1, 0):
            other = second_face(surface, place, radius, point, out.first)
            if other.dist < radius:
                out.count = 2
                out.second = normal_of(other)
                out.dist[1] = other.dist - radius
    return out
