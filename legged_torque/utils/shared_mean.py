"""Means over processes of one machine by memory that they share; over gloo, a laptop's training is a sixth slower."""

import os
import secrets
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path

import torch
from torch import Tensor

from legged_torque.utils.errors import LOST_PROCESS, UserError

ADDRESS, _KEY = "LEGGED_TORQUE_ADDRESS", "LEGGED_TORQUE_KEY"
"""Environment variables: where the first process listens, and what the others must know to be heard."""
_listeners: list[Listener] = []  # of the first process


def listen() -> None:
    """Listen for the processes that this one is about to start, which find it by their environment."""
    key = secrets.token_bytes(16)
    address = f"/tmp/legged_torque_{secrets.token_hex(8)}"  # TMPDIR may be too long for the name of a socket
    _listeners.append(Listener(address, backlog=64, authkey=key))
    os.environ.update({ADDRESS: address, _KEY: key.hex()})


class SharedMean:
    """Averages numbers of one process with those of the others, in a fixed order.

    Each process writes into a row of its own, meets the others, and reads all rows. Two sets of rows take turns, so
    that nobody writes where another one still reads: it has read when it is at the next meeting.
    """

    def __init__(self, rank: int, world_size: int) -> None:
        """Connect to the others: the first process to all, each other one to the first."""
        self._rank, self._world_size, self._address = rank, world_size, os.environ[ADDRESS]
        self._rows: dict[int, Tensor] = {}  # by how many numbers are averaged. Shapes: (2, world_size, numbers)
        self._turns: dict[int, int] = {}
        if rank == 0:
            with _listeners.pop() as listener:  # at whose end the file of its socket is removed
                self._others: list[Connection] = [listener.accept() for _ in range(1, world_size)]
        else:
            self._others = [Client(self._address, authkey=bytes.fromhex(os.environ[_KEY]))]

    def average(self, values: Tensor) -> Tensor:
        """Return the means over all processes, which call this in the same order. Shapes: (numbers,), float32."""
        size = len(values)
        if size not in self._rows:
            self._rows[size], self._turns[size] = self._share(size), 0
        rows = self._rows[size][self._turns[size]]
        self._turns[size] = 1 - self._turns[size]
        rows[self._rank].copy_(values)
        self._meet()
        return rows.mean(dim=0)

    def _share(self, size: int) -> Tensor:
        """Return rows that all processes share; their file is gone when all have it."""
        shape = (2, self._world_size, size)
        file = Path(f"{self._address}.{size}")
        if self._rank == 0:
            file.touch(mode=0o600, exist_ok=False)
            os.truncate(file, 4 * 2 * self._world_size * size)
        self._meet()
        rows = torch.from_file(str(file), shared=True, size=2 * self._world_size * size).view(shape)
        self._meet()
        if self._rank == 0:
            file.unlink()
        return rows

    def _meet(self) -> None:
        """Wait until all processes are here; the first one hears of each and then lets all go on."""
        try:
            if self._rank > 0:
                self._others[0].send_bytes(b"here")
            for other in self._others:
                other.recv_bytes()
            if self._rank == 0:
                for other in self._others:
                    other.send_bytes(b"go on")
        except (EOFError, OSError) as error:
            raise UserError(LOST_PROCESS) from error
