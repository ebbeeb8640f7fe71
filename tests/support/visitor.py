"""A visitor of the page without a browser."""

import contextlib

import msgspec
import viser
import zstandard
from support.clock import wait_for
from websockets.sync.client import connect

PROTOCOL = f"viser-v{viser.__version__}"  # as the page says it
CAMERA = {"type": "ViewerCameraMessage", "wxyz": (1, 0, 0, 0), "up_direction": (0, 0, 1), "near": 0.1, "far": 100}


@contextlib.contextmanager
def visitor(server, position=(3.0, 0.0, 1.0), aspect=1.0):
    """A function that sends messages as a browser does, whose camera looks at the origin, almost; see CAMERA.

    Its attribute ``receive`` is a function that gives the next messages for the browser, as they are written.
    """
    others = set(server.get_clients())
    how = {"subprotocols": [PROTOCOL], "max_size": None, "close_timeout": 0.5}  # it reads nothing, and so ends late
    with connect(f"ws://127.0.0.1:{server.get_port()}", **how) as socket:

        def send(**message):
            socket.send(msgspec.msgpack.encode(message))

        def receive(timeout):
            data = socket.recv(timeout)
            start = data.index(zstandard.MAGIC_NUMBER.to_bytes(4, "little"))
            return zstandard.ZstdDecompressor().decompressobj().decompress(data[start:])

        send.receive = receive
        picture = {"fov": 0.75, "image_height": 500, "image_width": int(500 * aspect)}
        send(**CAMERA, **picture, position=position, look_at=(0.0, 0.0, 0.1))
        wait_for(lambda: set(server.get_clients()) - others)
        yield send
