"""Kinds and levels of rough ground for watching and measuring a policy."""

from collections.abc import Sequence
from typing import Any

from legged_torque.terrain.tiles import TILES
from legged_torque.utils.config import section_keys
from legged_torque.utils.errors import UserError, check_names

ALL = "all"
"""Stands for all kinds."""
COLUMNS = 4
"""Of each kind, for trials: where tiles are random, these differ."""


def named_kinds(names: Sequence[str]) -> list[str]:
    """Return the kinds that a user has named, each once; a UserError if there is no such kind."""
    check_names("kind of terrain", names, [ALL, *TILES])
    return list(TILES) if ALL in names else list(dict.fromkeys(names))


def rising_levels(levels: Sequence[float]) -> list[float]:
    """Return difficulties in rising order, each once; a UserError if one is not from 0 to 1."""
    for level in levels:
        if not 0.0 <= level <= 1.0:
            raise UserError(f"a level must be from 0 to 1, not {level}")
    return sorted(set(levels))


def select_tiles(settings: Any, kinds: Sequence[str], levels: Sequence[float], columns: int) -> None:
    """Let a section ``terrain`` be rough ground, a plane's as well: rows of these levels, so many columns of each kind.

    Robots are to stay on their tiles. Without ``levels``, rows are as before.
    """
    settings.mesh_type, settings.curriculum = "heightfield", False
    settings.num_cols = columns * len(kinds)
    if levels:
        settings.num_rows, settings.difficulties = len(levels), list(levels)
    proportions, shares = settings.terrain_proportions, dict.fromkeys(kinds, 1.0 / max(len(kinds), 1))
    vars(proportions).update(dict.fromkeys(section_keys(proportions), 0.0) | shares)
    proportions._names = section_keys(proportions)  # also those that the task does not declare
