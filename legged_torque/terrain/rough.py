"""Rough ground in tiles, and the levels on which worlds train."""

import math
from typing import Any

import torch
from torch import Tensor

from legged_torque.terrain.height_map import HeightMap
from legged_torque.terrain.layout import TOO_LARGE, Layout
from legged_torque.terrain.terrain import Terrain
from legged_torque.utils.errors import UserError, check_names

COPIES, BYTES = 3.25, 4
"""Of a map on the device: for rewards and scans, for contacts, and what is greatest near each cell, and near each block
of four; in float32."""


class RoughGround(Terrain):
    """A map of tiles that all worlds share. Each world has a column for good and a row that changes: its level.

    Attributes:
        layout: Where the tiles lie.
        map: The surface.
        levels: Row of the tile on which each world starts its episodes. Shape: (num_envs,), int64.
        columns: Column of that tile. Shape: (num_envs,), int64.
    """

    def __init__(self, settings: Any, num_envs: int, device: str) -> None:
        """Make the map of a section ``terrain``, and spread worlds over all columns and the first levels.

        A UserError if there can be no such map, or the device has no room for it.
        """
        self.layout = layout = Layout.of(settings)
        if torch.device(device).type == "cuda":
            needed, (free, _) = COPIES * BYTES * math.prod(layout.shape), torch.cuda.mem_get_info(device)
            if needed > free:
                left = f"{device} has {free / 2**20:.0f} left"
                raise UserError(TOO_LARGE.format(f"needs {needed / 2**20:.0f} MiB, and {left}"))
        heights = layout.heights()
        self.map: HeightMap = HeightMap(heights, layout.horizontal_scale, layout.corner, device)
        self._origins = torch.as_tensor(layout.origins(heights), device=device)
        worlds = torch.arange(num_envs, device=device)
        self.columns = worlds * layout.num_cols // num_envs
        self._curriculum: bool = settings.curriculum
        self.levels = worlds % (settings.max_init_terrain_level + 1 if self._curriculum else layout.num_rows)

    @property
    def origins(self) -> Tensor:
        """Middle of the tile of each world [m]. Shape: (num_envs, 3)."""
        return self._origins[self.levels, self.columns]

    def move_to_origin(self, mask: Tensor, base_pos: Tensor) -> None:
        """Move trunks to the middles of their tiles."""
        base_pos.add_(torch.where(mask.unsqueeze(1), self.origins, 0.0))

    def end_episodes(self, mask: Tensor, base_pos: Tensor, commands: Tensor, episode_length_s: float) -> None:
        """Change levels by legged_gym's rule, if there is a curriculum.

        A robot that got further than half a tile goes a level up, and from the highest to any; else one that got less
        than half as far as its last command leads in a whole episode goes a level down.
        """
        if not self._curriculum:
            return
        distance = (base_pos - self.origins)[:, :2].norm(dim=1)
        up = distance > 0.5 * self.layout.tile_size
        down = ~up & (distance < 0.5 * episode_length_s * commands[:, :2].norm(dim=1))
        levels = (self.levels + up.long() - down.long()).clamp(min=0)
        num_rows = self.layout.num_rows
        levels = torch.where(levels < num_rows, levels, torch.randint_like(self.levels, num_rows))
        self.levels.copy_(torch.where(mask, levels, self.levels))

    def state_dict(self) -> dict[str, Tensor]:
        """Return the levels."""
        return {"levels": self.levels}

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return the mean level of all worlds."""
        return {"terrain_level": self.levels.float().mean()}


TERRAINS: dict[str, type[Terrain]] = {"plane": Terrain, "heightfield": RoughGround}
"""Kinds of ground, by ``terrain.mesh_type``."""


def make_terrain(settings: Any, num_envs: int, device: str) -> Terrain:
    """Return the ground that a section ``terrain`` of settings asks for; a UserError if there is no such ground."""
    check_names("terrain.mesh_type", [settings.mesh_type], TERRAINS)
    return TERRAINS[settings.mesh_type](settings, num_envs, device)
