"""Packets of numbers on their way from a sender to a receiver, which are late, jitter and get lost."""

import torch
import warp as wp
from torch import Tensor

from legged_torque.sim.randomization import RandomParameter
from legged_torque.utils.buffers import Buffers


@wp.struct
class Queue:
    """What :func:`received_packet` reads, see :class:`PacketQueue`."""

    newest: wp.array2d[float]
    before: wp.array3d[float]
    drawn: wp.array2d[float]
    extra: wp.array2d[float]
    unit_steps: int
    interval: int
    depth: int


@wp.func
def received_packet(queue: Queue, world: int, elapsed: int) -> wp.array[float]:
    """Return the packet that a world's receiver has ``elapsed`` physics steps after the newest was sent."""
    missing = int(wp.clamp(queue.drawn[world, 0], 0.0, 1.0e6)) * queue.unit_steps - elapsed
    age = int(wp.clamp((missing + queue.interval - 1) // queue.interval, 0, queue.depth))
    for packet in range(age, queue.extra.shape[1] - 1):  # type: ignore[attr-defined]
        if packet == age and float(missing - packet * queue.interval) + queue.extra[world, packet] > 0.0:
            age = packet + 1
    return wp.where(age > 0, queue.before[world, wp.max(age, 1) - 1], queue.newest[world])


@wp.kernel(enable_backward=False)
def send_packet(
    # In:
    packet: wp.array2d[float],
    rest: wp.array2d[float],
    seeds: wp.array[int],
    stream: int,
    loss: float,
    jitter: int,
    unit_steps: int,
    interval: int,
    # Out:
    newest: wp.array2d[float],
    before: wp.array3d[float],
    extra: wp.array2d[float],
):
    """Queue one number of a world's packet, which is in one array or two; arguments as of :class:`PacketQueue`.

    In place of a lost packet, the one before is queued once more, to arrive when that one does.
    """
    world, column = wp.tid()  # type: ignore[misc]
    is_lost, late = bool(False), int(0)
    if seeds.shape[0] > 0:
        random = wp.rand_init(seeds[world], stream)
        is_lost = wp.randf(random) < loss
        late = wp.randi(random, 0, jitter + 1) * unit_steps
    oldest = before.shape[1] - 1  # type: ignore[attr-defined]
    for i in range(oldest):
        before[world, oldest - i, column] = before[world, oldest - i - 1, column]
    if oldest >= 0:
        before[world, 0, column] = newest[world, column]
    if not is_lost:
        split = packet.shape[1]  # type: ignore[attr-defined]
        if column < split:
            newest[world, column] = packet[world, column]
        else:
            newest[world, column] = rest[world, column - split]
    if column == 0 and extra.shape[1] > 1:  # type: ignore[attr-defined]
        last = extra[world, 0]
        for i in range(oldest + 1):
            extra[world, oldest + 1 - i] = extra[world, oldest - i]
        extra[world, 0] = wp.where(is_lost, last - float(interval), float(late))


class PacketQueue(Buffers):
    """Packets that are sent at equal intervals, on their way in each world; time counts in physics steps.

    A packet takes a constant time, drawn at every reset, and an extra time of its own. The receiver has the newest
    packet that has arrived: one that arrives after a later one is never received, and a lost one leaves all as it was.

    Attributes:
        newest: The newest packet. Shape: (num_envs, width).
        before: Older ones, the newest first. Shape: (num_envs, depth, width).
        drawn: The constant time in units; its whole part counts. Shape: (num_envs, 1).
        extra: The extra times of all packets, the newest first [physics steps]; only with jitter. Shape: (num_envs,
            depth + 1).
        depth: How many older packets are kept.
        is_needed: Whether packets can be late or lost at all.
    """

    def __init__(
        self, like: Tensor, interval: int, times: tuple[int, int], unit_steps: int, jitter: int = 0, loss: float = 0.0
    ) -> None:
        """Allocate room for the longest time; there is none until one is drawn.

        Args:
            like: A packet of all worlds. Shape: (num_envs, width).
            interval: Physics steps from packet to packet.
            times: Lowest and highest constant time, in units.
            unit_steps: Physics steps of a unit.
            jitter: Longest extra time, in units; each whole number up to it is as likely.
            loss: Share of packets that are lost.
        """
        super().__init__(len(like), str(like.device))
        self.interval, self.times, self.unit_steps, self.jitter, self.loss = interval, times, unit_steps, jitter, loss
        self.depth = -(-(times[1] + jitter) * unit_steps // interval)
        self.is_needed, width = bool(self.depth or loss), like.shape[1]
        self.newest = self.buffer("newest", width) if self.is_needed else like
        self.before, self.drawn = self.buffer("before", self.depth, width), self.buffer("drawn", 1)
        self.extra = self.buffer("extra", self.depth + 1) if jitter else torch.zeros_like(self.drawn)
        self._numbers = torch.arange(self.depth, device=like.device)
        seeds = self.num_envs if jitter or loss else 0
        self.seeds = torch.zeros(seeds, dtype=torch.int32, device=like.device)

    def draw(self) -> None:
        """Draw new seeds of the next packets, which differ by their stream."""
        if len(self.seeds):
            self.seeds.random_()

    def send(self, packet: Tensor, rest: Tensor | None = None, stream: int = 0) -> None:
        """Send a packet, whose last numbers may be in a second tensor. Shape of both together: (num_envs, width)."""
        if self.is_needed:
            chances = (stream, self.loss, self.jitter, self.unit_steps, self.interval)
            arrays = (packet, packet[:, :0] if rest is None else rest, self.seeds, self.newest, self.before, self.extra)
            sent, other, seeds, *queue = (wp.from_torch(array) for array in arrays)
            wp.launch(send_packet, queue[0].shape, [sent, other, seeds, *chances, *queue], device=sent.device)

    def received(self, elapsed: int) -> Tensor:
        """Return by torch what has arrived ``elapsed`` steps after the newest was sent. Shape: (num_envs, width)."""
        if not self.depth:
            return self.newest
        missing = self.drawn.clamp(0.0, 1.0e6).int() * self.unit_steps - elapsed
        waiting = missing - self._numbers * self.interval + self.extra[:, : self.depth] > 0.0
        age = torch.where(waiting, self.depth, self._numbers).amin(dim=1, keepdim=True)
        older = self.before.take_along_dim((age - 1).clamp(min=0).unsqueeze(2), dim=1).squeeze(1)
        return torch.where(age > 0, older, self.newest)

    def reads(self) -> Queue:
        """Return the inputs of :func:`received_packet`."""
        queue = Queue()
        for name in Queue.vars:  # type: ignore[attr-defined]
            value = getattr(self, name)
            setattr(queue, name, wp.from_torch(value) if isinstance(value, Tensor) else value)
        return queue

    def restart(self, mask: Tensor, packet: Tensor) -> None:
        """Let the receiver have a packet, in the worlds of a mask, and none of those before.

        Shapes: (num_envs,), bool; (num_envs, width), or what torch broadcasts to it.
        """
        if self.is_needed:
            new = mask.unsqueeze(1)
            self.newest.copy_(torch.where(new, packet, self.newest))
            self.before.copy_(torch.where(new.unsqueeze(2), packet.unsqueeze(1), self.before))
            self.extra.masked_fill_(new, 0.0)

    def random_parameter(self, name: str) -> RandomParameter:
        """Return the constant time, any whole number of the range being as likely."""
        shortest, longest = self.times
        drawn, limits = {"set": [float(shortest), longest + 1.0]}, ([float(shortest)], [longest + 0.5])
        return RandomParameter(name, self.drawn, [0], drawn, limits=limits, at_reset_only=True)
