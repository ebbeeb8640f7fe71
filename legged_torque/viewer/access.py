"""Access to the page: only from this machine and from the page itself, or with the token in the printed address."""

import asyncio
import contextlib
import functools
import http
import ipaddress
import logging
import os
import secrets
import socket
import warnings
from collections.abc import Callable
from http.cookies import SimpleCookie
from typing import Any
from unittest import mock
from urllib.parse import parse_qs, urlsplit

import numpy as np
import viser
import websockets.asyncio.server
from viser._messages import GuiUpdateMessage, Message
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from legged_torque.viewer.training_viewer import free_port

MAX_MESSAGE = 2**16  # bytes of a message from a browser; longer ones end the connection
LOGGERS = ("asyncio", "websockets.server")  # quote what clients send wrong, which could fill the disk
TOKEN = "LEGGED_TORQUE_TOKEN"  # variable of the environment with the token for the next server, in place of a new one
VERSION = f"viser-v{viser.__version__}"  # of pages that may connect; viser prints all others


class LoopEvent(asyncio.Event):
    """Of a buffer of messages: other threads do not set it, since waiters then may miss it, and the page stands still.

    viser sets it from the thread that writes a message, and then from the loop's, where a second time does nothing.
    """

    def set(self) -> None:
        """Wake the waiters, from the thread of the event loop only."""
        with contextlib.suppress(RuntimeError):  # there is no loop in this thread
            asyncio.get_running_loop()
            super().set()


class GuardedServer(viser.ViserServer):
    """A viser server that accepts or refuses HTTP requests and WebSocket handshakes.

    Attributes:
        token: Required in the first request; empty if the server is reachable from this machine only.
    """

    def __init__(self, host: str, port: int, label: str) -> None:
        """Serve at a port or the next free one. A token is required unless the address is a loopback address."""
        self.token = "" if is_local(host) else os.environ.get(TOKEN) or secrets.token_hex(16)
        port = free_port(host, port)
        self._cookie = f"legged_torque_{port}"  # cookies are shared by all ports of a machine
        start = websockets.asyncio.server.serve

        def serve(*args: Any, process_request: Callable[..., Response | None], **settings: Any) -> Any:
            settings |= {"process_request": functools.partial(self._answer, process_request), "max_size": MAX_MESSAGE}
            return start(*args, **settings)

        with mock.patch.object(websockets.asyncio.server, "serve", serve):  # viser has no hook for requests
            super().__init__(host, port, label=label, verbose=False)
        for name in LOGGERS:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        warnings.filterwarnings("ignore", r"\[viser\]")  # as do the loggers
        sockets = self._websock_server
        sockets.get_message_buffer().message_event = LoopEvent()
        sockets.on_client_connect(lambda client: setattr(client.get_message_buffer(), "message_event", LoopEvent()))
        self._handle = sockets._handle_incoming_message
        sockets._handle_incoming_message = self._receive

    @property
    def url(self) -> str:
        """Address of the page for a browser on this machine, with the token if one is needed."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.get_host(), self.get_host())
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.get_port()}" + (f"/?token={self.token}" if self.token else "")

    async def _receive(self, client: Any, message: Message) -> None:
        """Handle a user's choice in a control, and nothing else: viser would set any attribute of a control."""
        if isinstance(message, GuiUpdateMessage) and list(message.updates) == ["value"]:
            control = self.gui._gui_input_handle_from_uuid.get(message.uuid)
            if control and is_choice(control, message.updates["value"]):
                await self._handle(client, message)

    def _answer(
        self, serve: Callable[..., Response | None], connection: ServerConnection, request: Request
    ) -> Response | None:
        """Refuse a request or answer it as ``serve`` does. A valid token is kept by the browser as a cookie."""
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if refusal := self._refusal(request, given):
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refusal}\n")
        response = serve(connection, request)
        if response is not None and self.token and given:
            response.headers["Set-Cookie"] = f"{self._cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return response

    def _refusal(self, request: Request, token: str) -> str:
        """Return why a request with a token in its address, or without one, is refused, or an empty string."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin", "")
        if origin and urlsplit(origin).netloc != host:
            return "only the page itself may connect, no page of another site"
        if "Upgrade" in request.headers and request.headers.get("Sec-WebSocket-Protocol") != VERSION:
            return "load the page again, it is of another version"
        if not self.token:  # another site may have its name resolved to this machine to pass as the page
            name = urlsplit(f"//{host}").hostname or "none"
            is_address = ":" in name or name.replace(".", "").isdecimal()
            return "" if name == "localhost" or is_address else "open the page by its address, not by a name"
        cookie = SimpleCookie(request.headers.get("Cookie", "")).get(self._cookie)
        texts = (token, cookie.value if cookie else "")
        is_known = any(secrets.compare_digest(text.encode(), self.token.encode()) for text in texts)
        return "" if is_known else "open the address that play.py has printed, with its token"


def is_local(host: str) -> bool:
    """Return whether only this machine reaches an address; unknown addresses count as others."""
    try:
        found = socket.getaddrinfo(host or "0.0.0.0", None)
    except OSError:
        return False
    return all(ipaddress.ip_address(address[0]).is_loopback for *_, address in found)


def is_choice(control: viser.GuiInputHandle[Any], value: Any) -> bool:
    """Return whether users can choose a value in a control of the page."""
    if isinstance(control, viser.GuiDropdownHandle):
        return value in control.options
    if isinstance(control, (viser.GuiSliderHandle, viser.GuiVector3Handle)):
        low, high, numbers = (np.atleast_1d(each) for each in (control.min, control.max, value))
        is_known = numbers.dtype.kind in "if" and numbers.shape == low.shape
        return is_known and bool(((low <= numbers) & (numbers <= high)).all())
    return isinstance(value, bool)  # of a box or a button
