"""Who may use the viewer's page, asked by real connections to a server behind its guard."""

import asyncio
import contextlib
import gzip
import http.client
import socket
import threading

import pytest

pytest.importorskip("websockets", reason="the extra 'viewer' is not installed")
from websockets.asyncio import server
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Response
from websockets.sync.client import connect

from legged_torque.viewer.access import Guard, is_local
from legged_torque.viewer.steering import Steering


def page(connection, request):
    """Answer as viser does: what asks for the page gets it, a connection of the page goes on."""
    is_connection = request.headers.get("Upgrade") == "websocket"
    return None if is_connection else Response(200, "OK", Headers({"Content-Length": "5"}), b"hello")


def html_page(connection, request):
    """Answer as viser does with its page, zipped for browsers that can unzip it."""
    body = b"<html><head><title>robots</title></head></html>"
    is_zipped = "gzip" in request.headers.get("Accept-Encoding", "")
    body = gzip.compress(body) if is_zipped else body
    encoding = "gzip" if is_zipped else "identity"
    return Response(200, "OK", Headers({"Content-Length": str(len(body)), "Content-Encoding": encoding}), body)


@contextlib.contextmanager
def serving(guard, page=page, **door):
    """A server on this machine that asks a guard; gives its port."""
    loop, ready, ports = asyncio.new_event_loop(), threading.Event(), []

    async def run():
        async with server.serve(lambda connection: connection.send("in"), "127.0.0.1", 0, process_request=page) as it:
            ports.append(it.sockets[0].getsockname()[1])
            ready.set()
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.Event().wait()

    with guard.at_the_door(**door):
        thread = threading.Thread(target=lambda: loop.run_until_complete(task), daemon=True)
        task = loop.create_task(run())
        thread.start()
        assert ready.wait(10)
    yield ports[0]
    loop.call_soon_threadsafe(task.cancel)
    thread.join(10)
    loop.close()


def get(port, path="/", **headers):
    """Ask for the page; return the status, and the cookie that comes with it."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    assert (response.status == 200) == (response.read() == b"hello")
    connection.close()
    return response.status, response.headers.get("Set-Cookie", "")


def connects(port, host="127.0.0.1", origin=None, cookie=None):
    """Whether the page's own connection is let in, of a page that was opened at ``host``, whatever that leads to."""
    headers = {"Cookie": cookie} if cookie else {}
    sock = socket.create_connection(("127.0.0.1", port), timeout=10)
    try:
        with connect(f"ws://{host}:{port}", sock=sock, origin=origin, additional_headers=headers) as connection:
            return connection.recv(timeout=10) == "in"
    except InvalidStatus as error:
        assert error.response.status_code == 403
        return False


def test_only_the_page_itself_connects():
    """On this machine: the page and programs, but no page of another site, also under a name that leads here."""
    with serving(Guard("127.0.0.1")) as port:
        assert get(port) == (200, "")
        for host in ("127.0.0.1", "localhost"):
            assert connects(port, host, f"http://{host}:{port}")
        assert connects(port)  # not a browser
        for origin in ("http://evil.example", f"http://evil.example:{port}", "http://127.0.0.1:1", "null"):
            assert not connects(port, origin=origin)
        assert not connects(port, "evil.example", f"http://evil.example:{port}")
        assert get(port, Host=f"evil.example:{port}")[0] == 403


def test_token():
    """For other machines: nothing without the token, which the browser keeps once the page was opened with it."""
    guard = Guard("0.0.0.0")
    assert len(guard.token) == 32 and guard.token != Guard("0.0.0.0").token
    with serving(guard) as port:
        for path in ("/", "/index.html", "/?token=", f"/?token={guard.token[:-1]}", "/?token=%C3%A4%FF"):
            assert get(port, path) == (403, "")
        assert not connects(port) and not connects(port, cookie=f"legged_torque={guard.token}")
        status, cookie = get(port, f"/?token={guard.token}")
        assert status == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie
        kept = cookie.split(";")[0]
        assert get(port, "/assets/page.js", Cookie=kept) == (200, "")
        assert connects(port, "robots.example", f"http://robots.example:{port}", kept)
        assert not connects(port, "robots.example", "http://evil.example", kept)


def test_servers_started_later_are_not_guarded():
    """The door is the guard's for as long as it stands there."""
    before = server.serve
    with Guard("127.0.0.1").at_the_door():
        assert server.serve is not before
    assert server.serve is before


@pytest.mark.parametrize(
    ("host", "expected"),
    [("127.0.0.1", True), ("localhost", True), ("127.0.0.2", True), ("0.0.0.0", False), ("", False), ("::", False)],
)
def test_addresses_that_only_this_machine_reaches(host, expected):
    """All others need a token."""
    assert is_local(host) is expected
    assert bool(Guard(host).token) is not expected


def answer(port, path, **headers):
    """Ask for a path; return status and body."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    body = response.read()
    connection.close()
    return response.status, body


def test_script_of_the_page():
    """It stands in the head of the page, zipped or not, and nowhere else."""
    with serving(Guard("127.0.0.1"), html_page, change=Steering().around) as port:
        plain = answer(port, "/")[1]
        assert plain.startswith(b"<html><head><script>") and plain.endswith(
            b"</script><title>robots</title></head></html>"
        )
        assert gzip.decompress(answer(port, "/?token=1", **{"Accept-Encoding": "gzip"})[1]) == plain
        assert b"<script>" not in answer(port, "/assets/other.html")[1]


@pytest.mark.parametrize(
    ("query", "headers", "status", "wish"),
    [
        ("shares=0.50,-1.00,0.00", {"X-Steer": "1"}, 204, (0.5, -1.0, 0.0)),
        ("shares=0.5,0,0", {}, 403, None),  # what a page of another site can send
        ("shares=0.5,0,0", {"X-Steer": "1", "Origin": "http://evil.example"}, 403, None),
        *((f"shares={text}", {"X-Steer": "1"}, 400, None) for text in ("nan,0,0", "1.01,0,0", "1,0", "a,b,c", "")),
        ("", {"X-Steer": "1"}, 400, None),
    ],
)
def test_wishes(query, headers, status, wish):
    """Three shares from the page itself are taken, once; everything else is refused."""
    steering = Steering()
    with serving(Guard("127.0.0.1"), change=steering.around) as port:
        assert answer(port, f"/steer?{query}", **headers)[0] == status
    assert steering.take() == wish and steering.take() is None


def test_steering_needs_the_token():
    """As everything else does, for other machines."""
    guard, steering = Guard("0.0.0.0"), Steering()
    with serving(guard, change=steering.around) as port:
        assert answer(port, "/steer?shares=1,0,0", **{"X-Steer": "1"})[0] == 403 and steering.take() is None
