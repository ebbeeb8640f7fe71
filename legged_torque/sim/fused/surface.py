"""The surface of a height map, two triangles per cell, and where a sphere touches it."""

import math

import numpy as np
import warp as wp

from legged_torque.sim.height_map import HeightMap

USUAL_RADIUS = 0.05
"""Spheres up to this size [m] that are high enough above the ground are known to be so from one number."""
MAX_REACH = wp.constant(0.2)
"""How far around the centre of a sphere that is below the surface the way out is looked for [m]."""
ALIKE = wp.constant(0.999)
"""Faces whose normals have this cosine, 2.6 degrees, are one face: a sphere never touches both."""
ON_EDGE = wp.constant(1.0e-5)
"""A point this share of a triangle's height outside of it is still inside, so that rounding leaves no gaps."""
MIN_DISTANCE = wp.constant(1.0e-6)
"""A direction over a shorter way [m] is lost in float32."""


@wp.struct
class Surface:
    """Heights on a square grid, continued at the borders with the heights there."""

    heights: wp.array2d(dtype=wp.float32)  # in the world [m]. Shape: (rows, cols); rows along x, columns along y
    scale: wp.float32  # side of a cell [m]
    corner: wp.vec2  # x and y of the first height [m]
    top: wp.float32  # the greatest height [m]
    ceiling: wp.array2d(dtype=wp.float32)  # the greatest height near each cell [m]. Shape: (rows - 1, cols - 1)
    near: wp.float32  # how far around a cell that is [m]


def make_surface(height_map: HeightMap) -> Surface:
    """Return a height map on the current device."""
    heights, scale = np.asarray(height_map.heights, np.float32), height_map.horizontal_scale
    cells = math.ceil(USUAL_RADIUS / scale)
    ceiling = np.pad(heights, cells, "edge")
    for _ in range(2):  # along one axis after the other: a cell's greatest height of so many cells on either side
        ends = range(len(ceiling) - 2 * cells - 1, len(ceiling) + 1)
        ceiling = np.maximum.reduce([ceiling[first:end] for first, end in enumerate(ends)]).T
    surface = Surface()
    surface.heights = wp.array(heights, dtype=wp.float32)
    surface.scale = scale
    surface.corner = wp.vec2(*height_map.corner)
    surface.top = float(heights.max())
    surface.ceiling = wp.array(ceiling, dtype=wp.float32)
    surface.near = cells * scale
    return surface


@wp.struct
class Touch:
    """The point of the surface that is nearest to the centre of a sphere, and a second one in a concave edge."""

    count: wp.int32  # how many of the two touch
    dist: wp.vec2  # distances between the surface and the sphere [m], negative where they overlap
    first: wp.vec3  # unit normals, towards the sphere
    second: wp.vec3


@wp.struct
class Triangle:
    """A triangle as seen from the centre of a sphere."""

    nearest: wp.vec3  # the point of its plane that is nearest to the centre; once known, that of the triangle
    is_face: wp.bool  # whether that is inside of it, not on its edges or at a vertex
    normal: wp.vec3  # upwards
    dist: wp.float32  # of the centre above its plane [m]


@wp.struct
class Cell:
    """The corners of a cell as seen from the centre of a sphere."""

    low: wp.vec3
    next_row: wp.vec3
    next_col: wp.vec3
    high: wp.vec3


@wp.struct
class Window:
    """The cells of a map that a sphere may touch; their places are relative to its centre."""

    first: wp.vec2i
    last: wp.vec2i
    start: wp.vec3  # from the centre to the place of height (0, 0), at z = 0


@wp.func
def half_of_cell(x: float, y: float) -> int:
    """Return in which of a cell's two triangles a place in it is; the diagonal runs from corner (0, 0) to (1, 1)."""
    return wp.where(x >= y, 0, 1)


@wp.func
def see_cell(surface: Surface, i: int, j: int, window: Window) -> Cell:
    """Return a cell as seen from the centre of the window's sphere."""
    rows, cols = surface.heights.shape[0], surface.heights.shape[1]
    row, next_row = wp.clamp(i, 0, rows - 1), wp.clamp(i + 1, 0, rows - 1)
    col, next_col = wp.clamp(j, 0, cols - 1), wp.clamp(j + 1, 0, cols - 1)
    x, y = surface.scale * float(i - window.first[0]), surface.scale * float(j - window.first[1])
    next_x, next_y = surface.scale * float(i + 1 - window.first[0]), surface.scale * float(j + 1 - window.first[1])
    cell = Cell()
    cell.low = window.start + wp.vec3(x, y, surface.heights[row, col])
    cell.next_row = window.start + wp.vec3(next_x, y, surface.heights[next_row, col])
    cell.next_col = window.start + wp.vec3(x, next_y, surface.heights[row, next_col])
    cell.high = window.start + wp.vec3(next_x, next_y, surface.heights[next_row, next_col])
    return cell


@wp.func
def see_triangle(cell: Cell, half: int) -> Triangle:
    """Return one of the two triangles of a cell; where it is nearest, if not with its face, is not known yet."""
    b, c = wp.where(half == 0, cell.next_row, cell.high), wp.where(half == 0, cell.high, cell.next_col)
    a = cell.low
    out = Triangle()
    area = wp.cross(b - a, c - a)
    out.normal = wp.normalize(area)
    out.dist = -wp.dot(out.normal, a)
    out.nearest = -out.dist * out.normal
    ab, bc, ca = wp.dot(area, wp.cross(a, b)), wp.dot(area, wp.cross(b, c)), wp.dot(area, wp.cross(c, a))
    out.is_face = wp.min(ab, wp.min(bc, ca)) >= -ON_EDGE * wp.dot(area, area)
    return out


@wp.func
def nearest_on_edge(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Return the point between ``a`` and ``b`` that is nearest to the origin."""
    edge = b - a
    return a + wp.clamp(-wp.dot(a, edge) / wp.dot(edge, edge), 0.0, 1.0) * edge


@wp.func
def nearest_on_edges(cell: Cell, half: int) -> wp.vec3:
    """Return the point of a triangle's edges that is nearest to the centre."""
    b, c = wp.where(half == 0, cell.next_row, cell.high), wp.where(half == 0, cell.high, cell.next_col)
    nearest = nearest_on_edge(cell.low, b)
    other = nearest_on_edge(b, c)
    if wp.length_sq(other) < wp.length_sq(nearest):
        nearest = other
    other = nearest_on_edge(c, cell.low)
    if wp.length_sq(other) < wp.length_sq(nearest):
        nearest = other
    return nearest


@wp.func
def make_window(surface: Surface, centre: wp.vec3, reach: float) -> Window:
    """Return the cells within a distance along x and y of a point.

    Outside of the map all is flat outwards: a place further out is like one near the border.
    """
    window = Window()
    margin = reach + 2.0 * surface.scale
    for k in range(2):
        place = wp.clamp(
            centre[k] - surface.corner[k], -margin, float(surface.heights.shape[k] - 1) * surface.scale + margin
        )
        window.first[k] = int(wp.floor((place - reach) / surface.scale))
        window.last[k] = int(wp.floor((place + reach) / surface.scale))
        window.start[k] = float(window.first[k]) * surface.scale - place
    window.start[2] = -centre[2]
    return window


@wp.func
def triangle_under(surface: Surface, centre: wp.vec3) -> Triangle:
    """Return the triangle that is vertically under, or above, a point."""
    window = make_window(surface, centre, 0.0)
    half = half_of_cell(-window.start[0], -window.start[1])
    cell = see_cell(surface, window.first[0], window.first[1], window)
    out = see_triangle(cell, half)
    if not out.is_face:
        out.nearest = nearest_on_edges(cell, half)
    return out


@wp.func
def distance_sq_to_cell(cell: Cell) -> float:
    """Return the squared distance from the centre to a cell, filled up to its highest corner."""
    top = wp.max(wp.max(cell.low[2], cell.next_row[2]), wp.max(cell.next_col[2], cell.high[2]))
    x, y = wp.max(cell.low[0], -cell.high[0]), wp.max(cell.low[1], -cell.high[1])
    away = wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(-top, 0.0))
    return wp.length_sq(away)


@wp.func
def farthest_along(cell: Cell, point: wp.vec3, direction: wp.vec3) -> float:
    """Return how far a cell is in front of a point at most, times the length of the direction."""
    first = wp.max(wp.dot(cell.low, direction), wp.dot(cell.next_row, direction))
    second = wp.max(wp.dot(cell.next_col, direction), wp.dot(cell.high, direction))
    return wp.max(first, second) - wp.dot(point, direction)


@wp.func
def is_clear(surface: Surface, centre: wp.vec3, radius: float) -> bool:
    """Return whether a sphere is above all that is near, which is all that most spheres need to know."""
    i = int(wp.clamp((centre[0] - surface.corner[0]) / surface.scale, 0.0, float(surface.ceiling.shape[0] - 1)))
    j = int(wp.clamp((centre[1] - surface.corner[1]) / surface.scale, 0.0, float(surface.ceiling.shape[1] - 1)))
    return radius <= surface.near and centre[2] - radius > surface.ceiling[i, j]


@wp.func
def nearest_triangle(surface: Surface, window: Window, reach: float, under: Triangle) -> Triangle:
    """Return which triangle is nearest to the centre of the window's sphere; among equals, one with its face.

    The one under the centre is where the search starts; others count within ``reach``.
    """
    best = under
    best_sq = wp.length_sq(best.nearest)
    for i in range(window.first[0], window.last[0] + 1):
        for j in range(window.first[1], window.last[1] + 1):
            cell = see_cell(surface, i, j, window)
            is_near = distance_sq_to_cell(cell) < (1.0 + ON_EDGE) * wp.min(best_sq, reach * reach)
            if best.is_face and farthest_along(cell, best.nearest, -best.nearest) <= ON_EDGE * best_sq:
                is_near = False  # all of it is behind that face
            if is_near:
                for half in range(2):
                    other = see_triangle(cell, half)
                    weight = float(1.0)
                    if other.is_face != best.is_face:
                        weight = wp.where(other.is_face, 1.0 - ON_EDGE, 1.0 + ON_EDGE)
                    if weight * other.dist * other.dist < best_sq:  # its plane is near enough
                        if not other.is_face:
                            other.nearest = nearest_on_edges(cell, half)
                        other_sq = wp.length_sq(other.nearest)
                        if weight * other_sq < best_sq:
                            best = other
                            best_sq = other_sq
    return best


@wp.func
def second_face(surface: Surface, window: Window, radius: float, point: wp.vec3, normal: wp.vec3) -> Triangle:
    """Return the deepest other face that a sphere touches at a concave edge, given where it touches the surface.

    Both points are in front of the other's face. One at the distance of the radius if there is none.
    """
    best = Triangle()
    best.dist = radius
    for i in range(window.first[0], window.last[0] + 1):
        for j in range(window.first[1], window.last[1] + 1):
            cell = see_cell(surface, i, j, window)
            is_near = distance_sq_to_cell(cell) < radius * radius
            if is_near and farthest_along(cell, point, normal) > 10.0 * MIN_DISTANCE:
                for half in range(2):
                    other = see_triangle(cell, half)
                    if other.is_face and other.dist < best.dist and wp.dot(normal, other.normal) < ALIKE:
                        way = other.nearest - point
                        if wp.min(wp.dot(way, normal), -wp.dot(way, other.normal)) > 10.0 * MIN_DISTANCE:
                            best = other
    return best


@wp.func
def touch_map(surface: Surface, centre: wp.vec3, radius: float) -> Touch:
    """Return where a sphere touches the surface.

    The nearest point of the whole surface is one of a face, or of an edge or vertex that sticks out: edges between
    triangles of one plane are never felt. Of a sphere whose centre is below the surface it is the shortest way out.
    """
    out = Touch()
    if is_clear(surface, centre, radius):
        return out
    under = triangle_under(surface, centre)
    above = under.dist / under.normal[2]
    reach = wp.max(radius, wp.min(-above, MAX_REACH))
    window = make_window(surface, centre, reach)
    nearest = nearest_triangle(surface, window, reach, under)
    away = wp.length(nearest.nearest)
    out.first = nearest.normal
    out.dist[0] = nearest.dist - radius
    if not nearest.is_face and away > MIN_DISTANCE:
        side = wp.where(above < 0.0, 1.0, -1.0)
        out.first = side * nearest.nearest / away
        out.dist[0] = -side * away - radius
    if out.dist[0] < 0.0:
        out.count = 1
        other = second_face(surface, window, radius, nearest.nearest, out.first)
        if other.dist < radius:
            out.count = 2
            out.second = other.normal
            out.dist[1] = other.dist - radius
    return out
