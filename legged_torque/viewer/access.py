"""Who may use the page: browsers on this machine, from nowhere but the page itself, or whoever has its token."""

from __future__ import annotations

import contextlib
import http
import ipaddress
import secrets
import socket
from collections.abc import Callable, Iterator
from http.cookies import SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response


class Guard:
    """Decides about requests: those for the page and its files, and the page's own connection.

    Attributes:
        token: What the address of the page must hold the first time; empty if none is needed.
    """

    def __init__(self, host: str) -> None:
        """Ask for a token unless ``host``, the address that is served at, is one that only this machine reaches."""
        self.token = "" if is_local(host) else secrets.token_hex(16)
        self._cookie = f"legged_torque_{secrets.token_hex(4)}"  # cookies of all ports of a machine are in one pot

    def refusal(self, request: Request) -> str:
        """Return why a request is refused; empty if it is not."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin", "")
        if origin and urlsplit(origin).netloc != host:
            return "only the page itself may connect, no page of another site"
        if not self.token:  # a site's name may be pointed at this machine to pass for the page
            name = urlsplit(f"//{host}").hostname or ""
            return "" if name == "localhost" or is_address(name) else "open the page by its address, not by a name"
        cookie = SimpleCookie(request.headers.get("Cookie", "")).get(self._cookie)
        given = (_token_of(request), cookie.value if cookie else "")
        is_known = any(secrets.compare_digest(text.encode(), self.token.encode()) for text in given)
        return "" if is_known else "open the address that play.py has printed, with its token"

    def answer(self, connection: ServerConnection, request: Request, serve: Callable[..., Any]) -> Response | None:
        """Answer a request with a refusal, or as ``serve`` does; a browser that has the token keeps it as a cookie."""
        refusal = self.refusal(request)
        if refusal:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refusal}\n")
        response = serve(connection, request)
        if response is not None and self.token and _token_of(request):
            response.headers["Set-Cookie"] = f"{self._cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return response

    @contextlib.contextmanager
    def at_the_door(self, change: Callable[[Callable], Callable] = lambda serve: serve) -> Iterator[None]:
        """Let every server that is started meanwhile ask this guard first: viser has no setting for it.

        ``change`` returns what serves requests that are let in, in place of the server's own function.
        """
        module: Any = websockets.asyncio.server  # for mypy, to which its attributes are fixed
        start = module.serve

        def guarded(*args: Any, process_request: Callable[..., Any], **settings: Any) -> Any:
            serve = change(process_request)

            def ask(connection: ServerConnection, request: Request) -> Response | None:
                return self.answer(connection, request, serve)

            return start(*args, process_request=ask, **settings)

        module.serve = guarded
        try:
            yield
        finally:
            module.serve = start


def is_local(host: str) -> bool:
    """Return whether only this machine reaches an address; one that cannot be found is left to who serves there."""
    try:
        found = socket.getaddrinfo(host or "0.0.0.0", None)
    except OSError:
        return False
    return all(ipaddress.ip_address(address[0]).is_loopback for *_, address in found)


def is_address(name: str) -> bool:
    """Return whether a host is given by its IP address."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _token_of(request: Request) -> str:
    """Return the token in the address of a request; empty if there is none."""
    return parse_qs(urlsplit(request.path).query).get("token", [""])[0]
