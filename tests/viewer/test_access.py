"""Who may use the page, asked by real connections to its server."""

import contextlib
import http.client
import socket

import pytest

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

import websockets.asyncio.server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from legged_torque.utils.errors import UserError
from legged_torque.viewer.access import GuardedServer, is_local
from legged_torque.viewer.ports import free_port


@contextlib.contextmanager
def serving(host):
    """A server; gives its port and its token."""
    server = GuardedServer(host, 8440, "title")
    yield server.get_port(), server.token
    assert server.request_share_url() is None
    server.stop()


def get(port, path="/", **headers):
    """Ask for the page; return the status, and the cookie that comes with it."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    assert (response.status == 403) == (b"<html" not in response.read())
    connection.close()
    return response.status, response.headers.get("Set-Cookie", "")


def connects(port, host="127.0.0.1", origin=None, cookie=None):
    """Whether the page's own connection is let in, of a page that was opened at ``host``, whatever that leads to."""
    headers = {"Cookie": cookie} if cookie else {}
    sock = socket.create_connection(("127.0.0.1", port), timeout=10)
    try:
        with connect(f"ws://{host}:{port}", sock=sock, origin=origin, additional_headers=headers):
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
