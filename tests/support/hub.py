"""A stand-in for the Hugging Face Hub: what huggingface_hub 1 and 2 ask for when a folder goes up and comes down."""

import base64
import contextlib
import hashlib
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Handler(BaseHTTPRequestHandler):
    """Keeps the files of each model in memory, as ``server.models[name][path]``."""

    protocol_version = "HTTP/1.1"

    def _answer(self, content, status=200, **headers):
        """Send bytes, or anything else as JSON."""
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in {"Content-Length": len(body), **headers}.items():
            self.send_header(name.replace("_", "-"), str(value))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_POST(self):
        """Make a model, say how files are to be sent, take a commit."""
        body = self.rfile.read(int(self.headers["Content-Length"] or 0))
        models, name = self.server.models, "/".join(self.path.split("/")[3:5])
        if self.path == "/api/repos/create":
            repository = "{organization}/{name}".format(**json.loads(body))
            models.setdefault(repository, {})
            self._answer({"url": f"{self.server.address}/{repository}", "name": repository, "id": repository})
        elif self.path == "/api/validate-yaml":
            self._answer({"errors": [], "warnings": []})
        elif "/preupload/" in self.path:
            paths = [file["path"] for file in json.loads(body)["files"]]
            self._answer({"files": [{"path": path, "uploadMode": "regular", "shouldIgnore": False} for path in paths]})
        elif "/commit/" in self.path:
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    models[name][line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            self._answer({"commitUrl": f"{self.server.address}/{name}/commit/{COMMIT}", "commitOid": COMMIT})

    def do_GET(self):
        """Describe a model, or give one of its files."""
        models = self.server.models
        if found := re.fullmatch(r"/api/models/(\w+/\w+)(/revision/\w+)?(\?.*)?", self.path):
            if found[1] not in models:
                self._answer({"error": "Repository not found"}, 404, X_Error_Code="RepoNotFound")
                return
            self._answer({"id": found[1], "modelId": found[1], "sha": COMMIT, "siblings": [], "tags": []})
        elif found := re.fullmatch(r"/api/models/(\w+/\w+)/tree/\w+(\?.*)?", self.path):
            files = models[found[1]].items()
            self._answer([{"type": "file", "path": path, "size": len(content), "oid": path} for path, content in files])
        elif found := re.fullmatch(r"/(\w+/\w+)/resolve/\w+/(.*)", self.path):
            content = models[found[1]][found[2]]
            self._answer(content, ETag=f'"{hashlib.sha256(content).hexdigest()}"', X_Repo_Commit=COMMIT)
        else:
            self._answer({"error": "not a part of the stand-in"}, 404)

    do_HEAD = do_GET  # noqa: N815 (http.server's name)

    def log_message(self, *_):
        """Say nothing."""


@contextlib.contextmanager
def running(handler=Handler):
    """A server with its address and, as ``models``, what it holds."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.models, server.address = {}, f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
