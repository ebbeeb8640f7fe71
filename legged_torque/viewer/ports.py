"""Where a page can be served. Needs no extra."""

from __future__ import annotations

import errno
import socket

from legged_torque.utils.errors import UserError


def free_port(host: str, port: int) -> int:
    """Return the first free port from a port on, or raise a UserError: at a wrong address viser would wait forever."""
    for candidate in range(port, min(port + 100, 65536)):
        try:
            (family, _, _, _, address), *_ = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
            return candidate
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise UserError(f"cannot serve at {host}:{candidate}: {error.strerror or error}") from None
    raise UserError(f"no port from {port} on is free")
