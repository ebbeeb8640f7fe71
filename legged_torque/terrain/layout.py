"""The layout of tiles of rough ground, and their map."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from legged_torque.terrain.tiles import START_SIZE, TILES, Grid
from legged_torque.utils.config import to_dict
from legged_torque.utils.errors import UserError, check_names

MAX_SAMPLES = 2**27
"""Of a map, which are half a gigabyte."""
TOO_LARGE = "the map of terrain.num_rows x terrain.num_cols tiles {}: raise terrain.horizontal_scale or make it smaller"


@dataclass(frozen=True)
class Layout:
    """A map of square tiles with flat ground around it: rows along x get more difficult, columns along y are kinds.

    The middle of the map is the world's origin, so that numbers of single precision are as fine as they can be.
    The fields are the settings of section ``terrain`` with these names. A UserError if tiles are not whole cells, there
    are too many, or columns cannot be of these kinds.
    """

    num_rows: int
    num_cols: int
    tile_size: float
    border_size: float
    horizontal_scale: float
    difficulty_range: list[float]
    terrain_proportions: dict[str, float]
    seed: int
    difficulties: list[float] = field(default_factory=list)

    @classmethod
    def of(cls, settings: Any) -> "Layout":
        """Return the layout that the section ``terrain`` of a task's settings asks for."""
        values = to_dict(settings)
        return cls(**{field.name: values[field.name] for field in dataclasses.fields(cls)})

    def __post_init__(self) -> None:
        """Check that the layout is possible."""
        for name in ("tile_size", "border_size"):
            cells = getattr(self, name) / self.horizontal_scale
            if abs(cells - round(cells)) > 1e-6 * cells:
                multiple = f"a multiple of terrain.horizontal_scale, {self.horizontal_scale}"
                raise UserError(f"terrain.{name} must be {multiple}, not {getattr(self, name)}")
        samples = math.prod(self.shape)
        if samples > MAX_SAMPLES:
            raise UserError(TOO_LARGE.format(f"has {samples} samples, more than {MAX_SAMPLES}"))
        if len(self.difficulties) not in (0, self.num_rows):
            given = f"not {len(self.difficulties)}: terrain.num_rows is {self.num_rows}"
            raise UserError(f"terrain.difficulties must be empty or one number for each row, {given}")
        check_names("kind in terrain.terrain_proportions", self.terrain_proportions, TILES)
        total = sum(self.terrain_proportions.values())
        if abs(total - 1.0) > 1e-6:
            raise UserError(f"terrain.terrain_proportions must sum to 1, not {total:g}")
        columns = self.kinds()
        for name, share in self.terrain_proportions.items():
            if share and name not in columns:
                column = f"a column: terrain.num_cols is {self.num_cols}"
                raise UserError(f"terrain.terrain_proportions.{name} of {share:g} is too small for {column}")

    def kinds(self) -> list[str]:
        """Return the kind of each column: as many of each as its share says, in the order of the shares."""
        names, shares = list(self.terrain_proportions), list(self.terrain_proportions.values())
        middles = (np.arange(self.num_cols) + 0.5) / self.num_cols
        places = np.searchsorted(np.cumsum(shares) - 1e-9, middles, side="right")
        return [names[min(place, len(names) - 1)] for place in places]

    def difficulty(self, row: int) -> float:
        """Return how difficult the tiles of a row are: of the range, the share of rows below, as in legged_gym."""
        if self.difficulties:
            return self.difficulties[row]
        lowest, highest = self.difficulty_range
        return lowest + (highest - lowest) * row / self.num_rows

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of samples along x and y."""
        rows, cols = (count * self._tile + 2 * self._border + 1 for count in (self.num_rows, self.num_cols))
        return rows, cols

    @property
    def corner(self) -> tuple[float, float]:
        """Return x and y of the first sample [m]."""
        rows, cols = self.shape
        return -0.5 * (rows - 1) * self.horizontal_scale, -0.5 * (cols - 1) * self.horizontal_scale

    def tile(self, row: int, col: int) -> np.ndarray:
        """Return the heights of one tile [m]; its random numbers are its own. Shape: as of a TileFunction."""
        kind, grid = self.kinds()[col], Grid(self._tile, self.horizontal_scale)
        heights = np.asarray(TILES[kind](self.difficulty(row), np.random.default_rng([self.seed, row, col]), grid))
        if heights.shape != grid.flat().shape or not np.isfinite(heights).all():
            raise UserError(f"the kind of tile '{kind}' must return finite heights of shape {grid.flat().shape}")
        return heights

    def heights(self) -> np.ndarray:
        """Return the heights of the whole map [m]. Where two tiles meet, the later one has the line of samples.

        Shape: :attr:`shape`, float32.
        """
        heights = np.zeros(self.shape, np.float32)
        for row, col in np.ndindex(self.num_rows, self.num_cols):
            x, y = self._border + row * self._tile, self._border + col * self._tile
            heights[x : x + self._tile + 1, y : y + self._tile + 1] = self.tile(row, col)
        return heights

    def origins(self, heights: np.ndarray) -> np.ndarray:
        """Return the middle of each tile, as high as the highest sample that robots start on [m].

        Shape: (num_rows, num_cols, 3), float32.
        """
        result = np.empty((self.num_rows, self.num_cols, 3), np.float32)
        reach, middle = 0.5 * START_SIZE / self.horizontal_scale, self._border + 0.5 * self._tile
        start = slice(math.floor(middle - reach), math.ceil(middle + reach) + 1)  # of the first tile
        for row, col in np.ndindex(self.num_rows, self.num_cols):
            highest = heights[row * self._tile :, col * self._tile :][start, start].max()
            result[row, col] = (row - 0.5 * self.num_rows + 0.5), (col - 0.5 * self.num_cols + 0.5), highest
        result[..., :2] *= self.tile_size
        return result

    @property
    def _tile(self) -> int:
        """Cells of a side of a tile."""
        return round(self.tile_size / self.horizontal_scale)

    @property
    def _border(self) -> int:
        """Cells of the border."""
        return round(self.border_size / self.horizontal_scale)
