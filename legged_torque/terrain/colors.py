"""Colors of kinds of ground in pictures, videos and viewers: calm ones, on which dark robots are seen well."""

NEUTRAL = (206, 208, 210)
"""Of level ground, and of what lies around the tiles. Each color is red, green and blue, up to 255."""
OWN = (204, 190, 214)
"""Of kinds that users have added."""
COLORS = {
    "flat": NEUTRAL,
    "smooth_slope_up": (176, 203, 164),
    "smooth_slope_down": (143, 186, 158),
    "rough_slope": (199, 193, 143),
    "stairs_up": (151, 186, 213),
    "stairs_down": (172, 172, 217),
    "discrete_obstacles": (222, 177, 148),
    "waves": (140, 200, 198),
    "stepping_stones": (207, 166, 198),
    "gaps": (224, 160, 160),
    "pits": (228, 207, 140),
}
"""By kind."""


def color_of(kind: str) -> tuple[int, int, int]:
    """Return the color of a kind of tile."""
    return COLORS.get(kind, OWN)
