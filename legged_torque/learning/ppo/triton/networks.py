"""Layout of networks: the columns of shared memory that each layer reads and writes.

A network is a list of :class:`Layer`. Where a layer reads the outputs of several others, their columns are next to each
other. All widths are multiples of :data:`ALIGNMENT`, with zeros in between.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from rsl_rl.modules import MLP
from torch import Tensor, nn

from legged_torque.learning.multi_head import MultiHeadMLP

ALIGNMENT = 64  # columns and rows of weights; what a matrix product reads at a time


def aligned(size: int, step: int = ALIGNMENT) -> int:
    """Return the next multiple of a step."""
    return -(-size // step) * step


@dataclass(eq=False)
class Block:
    """Rows of numbers, one per sample, in which columns are handed out."""

    width: int = 0

    def columns(self, size: int, elu: bool = False) -> "Columns":
        """Hand out the next columns."""
        columns = Columns(self, self.width, size, elu)
        self.width += aligned(size)
        return columns


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns that one layer writes, or the inputs of a network."""

    block: Block
    start: int
    size: int
    elu: bool = False  # whether an ELU has been applied to them


@dataclass(frozen=True, eq=False)
class Layer:
    """A linear map from columns, all of one block and next to each other, followed by an ELU where ``target`` says."""

    linear: nn.Linear
    sources: Sequence[Columns]
    target: Columns
    first_output: int | None = None  # its first column among the outputs of all networks; None: a hidden layer

    def input_columns(self) -> Tensor:
        """Return which column of the block, from the first source on, each input is. Shape: (inputs,)."""
        start = self.sources[0].start
        return torch.cat([torch.arange(source.size) + source.start - start for source in self.sources])

    @property
    def input_width(self) -> int:
        """Columns of the inputs with the zeros between and behind them."""
        return sum(aligned(source.size) for source in self.sources)


def mlp_layers(
    module: MLP, sources: Sequence[Columns], first_output: int | None, into: Block | None = None
) -> list[Layer]:
    """Return the layers of an MLP that reads ``sources``; the last one writes ``into`` a block if one is given.

    ``first_output`` is as in :class:`Layer`, for the last one.
    """
    layers = []
    linears = [part for part in module if isinstance(part, nn.Linear)]
    ends_linear = isinstance(module[-1], nn.Linear)
    for linear in linears:
        is_last = linear is linears[-1]
        block = into if into and is_last else Block()
        target = block.columns(linear.out_features, elu=not (is_last and ends_linear))
        layers.append(Layer(linear, sources, target, first_output if is_last else None))
        sources = [target]
    return layers


def read_network(module: nn.Module, first_output: int = 0) -> list[Layer]:
    """Return the layers of an rsl_rl ``MLP`` or of our ``MultiHeadMLP`` with ELUs; none of any other network.

    They are in the order in which they are computed; the first one reads the inputs. ``first_output`` is the column of
    the network's first output among those of all networks.
    """
    parts = [part for part in module.modules() if not list(part.children())]
    if not all(isinstance(part, nn.Linear) or (isinstance(part, nn.ELU) and part.alpha == 1.0) for part in parts):
        return []
    if isinstance(module, MLP):
        if not (isinstance(module[0], nn.Linear) and isinstance(module[-1], nn.Linear)):
            return []
        return mlp_layers(module, [Block().columns(module[0].in_features)], first_output)
    if isinstance(module, MultiHeadMLP):
        seen = Block()  # by the torque head
        trunk = mlp_layers(module.trunk, [Block().columns(module.trunk[0].in_features)], None, seen)
        features = trunk[-1].target
        position_head = mlp_layers(module.position_head, [features], first_output, seen)
        angles = position_head[-1].target
        torque_head = mlp_layers(module.torque_head, [features, angles], first_output + angles.size)
        return [*trunk, *position_head, *torque_head]
    return []
