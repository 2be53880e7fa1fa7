"""A stand-in for the Hugging Face Hub on loopback: takes in the files of one commit, or answers with an error."""

import base64
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


class HubServer(ThreadingHTTPServer):
    """What it was sent: tokens, and files by path."""

    def __init__(self, status: int) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.status, self.tokens, self.files = status, set[str](), dict[str, bytes]()
        self.address = f"http://127.0.0.1:{self.server_address[1]}"

    def answer(self, path: str, body: bytes) -> dict[str, Any]:
        """What the Hub says to a request."""
        if path.endswith("/repos/create"):
            return {"url": f"{self.address}/datasets/me/data", "name": "me/data"}
        if "/preupload/" in path:
            files = [each["path"] for each in json.loads(body)["files"]]
            return {"files": [{"path": name, "uploadMode": "regular", "shouldIgnore": False} for name in files]}
        if "/commit/" in path:
            for each in map(json.loads, body.splitlines()):
                if each["key"] == "file":
                    self.files[each["value"]["path"]] = base64.b64decode(each["value"]["content"])
            return {"commitUrl": f"{self.address}/datasets/me/data/commit/0", "commitOid": "0" * 40}
        return {"errors": [], "warnings": []}


class _Handler(BaseHTTPRequestHandler):
    server: HubServer

    def log_message(self, *args: Any) -> None:
        """Say nothing."""

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("content-length") or 0))
        self.server.tokens.add(self.headers.get("authorization", ""))
        answer = self.server.answer(self.path, body) if self.server.status == 200 else {"error": "no"}
        data = json.dumps(answer).encode()
        self.send_response(self.server.status)
        self.send_header("content-type", "application/json")
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


@contextmanager
def hub_server(status: int = 200) -> Iterator[HubServer]:
    """The server, for as long as the context lasts."""
    with HubServer(status) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
