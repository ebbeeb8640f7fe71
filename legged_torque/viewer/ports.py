"""Ports for pages. Needs no extra."""

import errno
import socket

from legged_torque.utils.errors import UserError


def free_port(host: str, port: int) -> int:
    """Return the first free port from a port on; a UserError for an address that is not this machine's."""
    for candidate in range(port, 65536):
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            with socket.create_server((host, candidate), family=family):
                return candidate
        except OSError as error:
            if error.errno != errno.EADDRINUSE:  # viser would try all ports forever
                raise UserError(f"cannot serve at {host}:{candidate}: {error.strerror or error}") from None
    raise UserError(f"no port from {port} on is free")
