"""Steering with keys and a gamepad, which viser cannot: a script on the page that asks for commands."""

from __future__ import annotations

import functools
import gzip
import http
import math
from collections import deque
from collections.abc import Callable
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

Serve = Callable[[ServerConnection, Request], Response | None]
PATH, HEADER = "/steer", "X-Steer"  # a page of another site cannot send the header

SCRIPT = """<script>
(() => {
  const keys = {KeyW: [0, 1], ArrowUp: [0, 1], KeyS: [0, -1], ArrowDown: [0, -1], KeyA: [1, 1], KeyD: [1, -1],
                ArrowLeft: [2, 1], ArrowRight: [2, -1]};
  const held = new Set();
  let sent = "0.00,0.00,0.00", isBusy = false;
  const press = event => {
    const uses = event.code.startsWith("Arrow") ? "input, textarea, [role]:not([role=dialog])" : "input, textarea";
    if (!(event.code in keys) || event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.(uses)) return;
    held.add(event.code);
    event.preventDefault();
    event.stopImmediatePropagation();  // WASD would move viser's camera
  };
  addEventListener("keydown", press, true);
  addEventListener("keyup", event => held.delete(event.code), true);
  addEventListener("blur", () => held.clear());
  setInterval(async () => {
    const shares = [0, 0, 0];
    for (const code of held) shares[keys[code][0]] += keys[code][1];
    const pad = navigator.getGamepads?.().find(each => each?.mapping === "standard");
    if (pad) [1, 0, 2].forEach((axis, i) => { if (Math.abs(pad.axes[axis]) > 0.12) shares[i] -= pad.axes[axis]; });
    const wanted = shares.map(share => Math.max(-1, Math.min(1, share)).toFixed(2)).join(",");
    if (wanted === sent || isBusy) return;
    isBusy = true;
    try {
      if ((await fetch("PATH?shares=" + wanted, {headers: {"HEADER": "1"}})).ok) sent = wanted;
    } catch {} finally { isBusy = false; }
  }, 50);
})();
</script>""".replace("PATH", PATH).replace("HEADER", HEADER)
"""Sends shares of the largest v_x, v_y and yaw rate, -1 to 1, whenever they change: while keys are held (W S, A D and
arrows) or sticks of a gamepad are moved."""


class Steering:
    """Takes what the page's script sends, in the thread of the server, for another thread."""

    def __init__(self) -> None:
        """Start without a wish."""
        self._wishes: deque[tuple[float, ...]] = deque(maxlen=1)

    def take(self) -> tuple[float, ...] | None:
        """Return the last new wish as shares of the largest v_x, v_y and yaw rate, -1 to 1; None if there is none."""
        return self._wishes.pop() if self._wishes else None

    def around(self, serve: Serve) -> Serve:
        """Return a function that serves as another one does, adds the script to the page, and takes wishes."""

        def steered(connection: ServerConnection, request: Request) -> Response | None:
            address = urlsplit(request.path)
            if address.path == PATH:
                return connection.respond(self._hear(request, address.query), "")
            response = serve(connection, request)
            return with_script(response) if response is not None and address.path in ("/", "/index.html") else response

        return steered

    def _hear(self, request: Request, query: str) -> http.HTTPStatus:
        """Note a wish, and return the status of the answer."""
        try:
            shares = tuple(map(float, parse_qs(query)["shares"][0].split(",")))
        except (KeyError, ValueError):
            return http.HTTPStatus.BAD_REQUEST
        if HEADER not in request.headers:
            return http.HTTPStatus.FORBIDDEN
        if len(shares) != 3 or not all(math.isfinite(share) and abs(share) <= 1.0 for share in shares):
            return http.HTTPStatus.BAD_REQUEST
        self._wishes.append(shares)
        return http.HTTPStatus.NO_CONTENT


def with_script(response: Response) -> Response:
    """Return a page with the script in it."""
    body = added(bytes(response.body or b""), response.headers.get("Content-Encoding") == "gzip")
    fields = [(name, value) for name, value in response.headers.raw_items() if name != "Content-Length"]
    headers = Headers([*fields, ("Content-Length", str(len(body)))])
    return Response(response.status_code, response.reason_phrase, headers, body)


@functools.lru_cache(maxsize=2)
def added(page: bytes, is_zipped: bool) -> bytes:
    """Return a page with the script at the start of its head, both zipped or not."""
    plain = gzip.decompress(page) if is_zipped else page
    plain = plain.replace(b"<head>", b"<head>" + SCRIPT.encode(), 1)
    return gzip.compress(plain) if is_zipped else plain
