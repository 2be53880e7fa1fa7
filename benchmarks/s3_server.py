"""An S3 server on loopback, in a process of its own, for measuring and for tests; a development dependency (moto)."""

import importlib.util
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from shared.errors import UsageError, WorkerError
from shared.io.interpreter import PYTHON, own_environment

BUCKET = "adaafford"


def serve() -> None:
    """Serve until standard input ends; the port is printed first."""
    import logging
    import urllib.request

    from moto.moto_server.werkzeug_app import create_backend_app
    from werkzeug.serving import make_server

    # Told which service is meant, moto need not look for it anew at each request, which takes it half of its time.
    moto, writing = create_backend_app("s3"), threading.Lock()

    def one_writer(environ: Any, start_response: Any) -> Any:
        """Answer a request. Moto looks whether a file is there and makes it in two steps, so one writer at a time."""
        if environ["REQUEST_METHOD"] == "GET":
            return moto(environ, start_response)
        with writing:
            return moto(environ, start_response)

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = make_server("127.0.0.1", 0, one_writer, threaded=True)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    urllib.request.urlopen(urllib.request.Request(f"http://127.0.0.1:{server.port}/{BUCKET}", method="PUT")).close()
    print(server.port, flush=True)
    sys.stdin.read()
    server.shutdown()


@contextmanager
def loopback_server() -> Iterator[str]:
    """Address of a server with one empty bucket, `BUCKET`.

    Raises:
        UsageError: moto is not installed.
        WorkerError: the server did not start.
    """
    if importlib.util.find_spec("moto") is None:
        raise UsageError("an S3 server on loopback needs the development dependencies; install adaafford[dev]")
    command = [*PYTHON, __file__]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=own_environment()) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        try:
            port = server.stdout.readline().strip()
            if not port.isdigit():
                raise WorkerError("the S3 server on loopback did not start")
            yield f"http://127.0.0.1:{port}"
        finally:
            server.stdin.close()


@contextmanager
def loopback_bucket() -> Iterator[str]:
    """An s3:// URL on such a server, which this process's environment names meanwhile."""
    with loopback_server() as endpoint:
        named = {
            "AWS_ENDPOINT_URL": endpoint,
            "AWS_ACCESS_KEY_ID": "loopback",
            "AWS_SECRET_ACCESS_KEY": "loopback",
            "AWS_REGION": "us-east-1",
        }
        before = {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
        for name in before:
            del os.environ[name]
        os.environ.update(named)
        try:
            yield f"s3://{BUCKET}/benchmark"
        finally:
            for name in named:
                del os.environ[name]
            os.environ.update(before)


if __name__ == "__main__":
    serve()
