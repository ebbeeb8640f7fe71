"""Which kinds of rough ground, and how difficult, a policy is watched or measured on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from legged_torque.terrain.tiles import TILES
from legged_torque.utils.config import to_dict
from legged_torque.utils.errors import UserError, unknown_name


def select_tiles(settings: Any, kinds: Sequence[str] = (), difficulty: float | None = None) -> None:
    """Change the section ``terrain`` of a task with rough ground to tiles of some kinds at one difficulty.

    Args:
        settings: The section. Robots will stay on the levels on which they start.
        kinds: They get the same number of columns each, and no fewer in all than there are; none keeps all as they are.
        difficulty: Of all tiles, in a single row; None keeps the rows.

    Raises:
        UserError: If the ground is a plane, a kind is unknown, or the difficulty is not from 0 to 1.
    """
    if settings.mesh_type == "plane":
        raise UserError("--terrain and --level are for tasks on rough ground; this one has a plane")
    settings.curriculum = False
    kinds = list(dict.fromkeys(kinds))
    if kinds:
        shares = settings.terrain_proportions
        for name in kinds:
            if name not in TILES:
                raise unknown_name("kind of --terrain", name, TILES)
        for name in {*to_dict(shares), *kinds}:
            setattr(shares, name, 1.0 / len(kinds) if name in kinds else 0.0)
        settings.num_cols = -(-settings.num_cols // len(kinds)) * len(kinds)
    if difficulty is not None:
        if not 0.0 <= difficulty <= 1.0:  # NaN is neither
            raise UserError(f"--level must be from 0 to 1, not {difficulty}")
        settings.difficulty_range, settings.num_rows = [difficulty, difficulty], 1
