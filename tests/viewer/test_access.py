"""Who may use the page, asked by real connections to its server, and what reaches them."""

import asyncio
import contextlib
import http.client
import socket
import sys
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

import websockets.asyncio.server
from support.clock import wait_for
from support.visitor import PROTOCOL, visitor
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from legged_torque.utils.errors import UserError
from legged_torque.viewer.access import TOKEN, GuardedServer, is_local
from legged_torque.viewer.training_viewer import free_port

FORGED = {
    "box": [{"removed": True}, {"value": "yes"}, {"value": True, "removed": True}, {"no_such": 1}, {"update_cb": []}],
    "slider": [{"value": value} for value in (7.0, float("nan"), "1.0", None, [0.5])] + [{"uuid": "x"}],
    "list": [{"value": "77"}, {"value": [0]}, {"value": 1}, {"options": ["7"]}],
    "vector": [{"value": value} for value in ([9, 0, 0], [0, float("nan"), 0], [0, 0], "000", [[0, 0, 0]] * 3)],
}
"""Updates that no control of these kinds sends."""
CHOICES = {"box": True, "slider": 1.5, "list": "b", "vector": [1.0, -1.0, 0.5]}


@contextlib.contextmanager
def serving(host):
    """A server; gives its port and its token."""
    server = GuardedServer(host, 8440, "title")
    yield server.get_port(), server.token
    server.stop()


def test_only_choices_count(monkeypatch, capfd, caplog, recwarn):
    """What no control sends changes nothing, of whatever kind and size, and fills no log; then choices still count."""
    server, tunnels = GuardedServer("127.0.0.1", 8440, "title"), []
    monkeypatch.setattr(server, "request_share_url", lambda: tunnels.append("open"))
    controls = {
        "box": server.gui.add_checkbox("box", False),
        "slider": server.gui.add_slider("slider", 0.5, 2.0, 0.5, 1.0),
        "list": server.gui.add_dropdown("list", ("a", "b")),
        "vector": server.gui.add_vector3("vector", (0.0, 0.0, 0.0), min=(-1.0, -1.0, -1.0), max=(1.0, 1.0, 1.0)),
    }
    before = {name: vars(each._impl).copy() for name, each in controls.items()}
    capfd.readouterr()
    with visitor(server) as send:
        for name, forged in FORGED.items():
            for updates in forged:
                send(type="GuiUpdateMessage", uuid=before[name]["uuid"], updates=updates)
        send(type="ShareUrlRequest")
    with contextlib.suppress(ConnectionClosed), visitor(server) as send:
        for number in range(3):  # with more of them, stopping the server takes 6 s
            send(type="ViewerCameraMessage", wxyz=f"{number}" * 10_000)
    for message in ({"type": "x" * 10_000}, {"type": "GuiUpdateMessage", "uuid": "x" * 1_000_000}):
        with contextlib.suppress(ConnectionClosed), visitor(server) as send:
            send(**message)
    with pytest.raises(InvalidStatus), connect(f"ws://127.0.0.1:{server.get_port()}", subprotocols=["viser-v0" * 500]):
        pass
    assert {name: vars(each._impl) for name, each in controls.items()} == before and not tunnels
    with visitor(server) as send:
        for name, value in CHOICES.items():
            send(type="GuiUpdateMessage", uuid=before[name]["uuid"], updates={"value": value})
        wait_for(lambda: [each.value for each in controls.values()] == [True, 1.5, "b", (1.0, -1.0, 0.5)])
    server.stop()
    written = capfd.readouterr()
    noted = "".join(str(each.message) for each in recwarn)
    assert len(written.out + written.err + caplog.text + noted) < 1000


def get(port, path="/", **headers):
    """Ask for the page; return the status, and the cookie that comes with it."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    assert (response.status == 403) == (b"<html" not in response.read())
    connection.close()
    return response.status, response.headers.get("Set-Cookie", "")


def connects(port, host="127.0.0.1", origin=None, cookie=None):
    """Whether the page's own connection is let in, of a page that was opened at ``host``, whatever that leads to."""
    headers = {"Cookie": cookie} if cookie else {}
    sock = socket.create_connection(("127.0.0.1", port), timeout=120)
    try:
        with connect(
            f"ws://{host}:{port}", sock=sock, origin=origin, additional_headers=headers, subprotocols=[PROTOCOL]
        ):
            return True
    except InvalidStatus as error:
        assert error.response.status_code == 403
        return False


def test_only_the_page_itself_connects():
    """On this machine: the page and programs, but no page of another site, also under a name that leads here."""
    before = websockets.asyncio.server.serve
    with serving("127.0.0.1") as (port, _):
        assert websockets.asyncio.server.serve is before  # other servers are not guarded
        assert get(port) == (200, "")
        for host in ("127.0.0.1", "localhost"):
            assert connects(port, host, f"http://{host}:{port}")
        assert connects(port)  # not a browser
        for origin in ("http://evil.example", f"http://evil.example:{port}", "http://127.0.0.1:1", "null"):
            assert not connects(port, origin=origin)
        assert not connects(port, "evil.example", f"http://evil.example:{port}")
        for host in (f"evil.example:{port}", "127.0.0.1.evil.example", ""):
            assert get(port, Host=host)[0] == 403


def test_token():
    """For other machines: nothing without the token, which the browser keeps once the page was opened with it."""
    with serving("0.0.0.0") as (port, token), serving("0.0.0.0") as (_, other):
        assert len(token) == 32 and token != other
        for path in ("/", "/index.html", "/?token=", f"/?token={token[:-1]}", "/?token=%C3%A4%FF"):
            assert get(port, path) == (403, "")
        assert not connects(port) and not connects(port, cookie=f"legged_torque={token}")
        status, cookie = get(port, f"/?token={token}")
        assert status == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie
        kept = cookie.split(";")[0]
        assert get(port, "/index.html", Cookie=kept) == (200, "")
        assert connects(port, "robots.example", f"http://robots.example:{port}", kept)
        assert not connects(port, "robots.example", "http://evil.example", kept)


def test_another_server_in_its_place(monkeypatch):
    """At the same port and with the token of the first one, it knows the browsers that did."""
    with serving("0.0.0.0") as (port, token):
        kept = get(port, f"/?token={token}")[1].split(";")[0]
    monkeypatch.setenv(TOKEN, token)
    with serving("0.0.0.0") as again:
        assert again == (port, token) and connects(port, cookie=kept)
    monkeypatch.setenv(TOKEN, "")
    with serving("0.0.0.0") as (port, other):
        assert len(other) == 32 and not connects(port, cookie=kept)


@pytest.mark.skipif(not Path("/proc/net/if_inet6").exists(), reason="this machine has no IPv6")
@pytest.mark.parametrize(("host", "shown"), [("::1", "::1"), ("::", "::1")])
def test_addresses_of_version_6(host, shown):
    """Browsers want them in brackets, and one of this machine."""
    server = GuardedServer(host, 8440, "title")
    parts, address = urlsplit(server.url), f"http://[{shown}]:{server.get_port()}"
    assert server.url == address + (f"/?token={server.token}" if host == "::" else "")
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=120)
    connection.request("GET", f"/?{parts.query}")
    assert connection.getresponse().status == 200
    connection.close()
    server.stop()


@pytest.mark.parametrize(
    ("host", "expected"),
    [("127.0.0.1", True), ("localhost", True), ("127.0.0.2", True), ("0.0.0.0", False), ("", False), ("::", False)],
)
def test_addresses_that_only_this_machine_reaches(host, expected):
    """All others need a token."""
    assert is_local(host) is expected


def test_ports():
    """The next free port is taken; an address that is not this machine's is refused."""
    with socket.create_server(("127.0.0.1", free_port("127.0.0.1", 8430))) as taken:
        port = taken.getsockname()[1]
        assert free_port("127.0.0.1", port) > port
    with pytest.raises(UserError, match=r"cannot serve at 192\.0\.2\.1:8480"):
        free_port("192.0.2.1", 8480)
    with pytest.raises(UserError, match="cannot serve at no-such-host:8480"):
        free_port("no-such-host", 8480)


@pytest.mark.parametrize("is_for_all", [True, False])
def test_no_message_is_missed(is_for_all):
    """What another thread writes at the very moment at which a connection begins to wait for messages arrives."""
    server, expected = GuardedServer("127.0.0.1", 8440, "title"), []
    loop = server._websock_server._background_event_loop
    make = loop.create_future

    def create_future():
        """Write between a look at an event and the wait for it."""
        if sys._getframe(1).f_code is asyncio.Event.wait.__code__ and len(expected) < 5:
            expected.append(f"message {len(expected)}")
            to = server if is_for_all else next(iter(server.get_clients().values()))
            writer = threading.Thread(target=to.gui.add_html, args=(expected[-1],))
            writer.start()
            writer.join()
        return make()

    with visitor(server) as send:
        loop.create_future = create_future
        for to in (server, *server.get_clients().values()):
            to.gui.add_html("first")
        wait_for(lambda: len(expected) == 5)
        while expected[-1].encode() not in send.receive(timeout=10.0):
            pass
    server.stop()
