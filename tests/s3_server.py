"""An S3 server on loopback, in a process of its own; ends with its standard input. Run as a script by conftest.py."""

import logging
import sys
import urllib.request

from moto.server import ThreadedMotoServer

BUCKET = "adaafford"

if __name__ == "__main__":
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    urllib.request.urlopen(urllib.request.Request(f"http://{host}:{port}/{BUCKET}", method="PUT")).close()
    print(port, flush=True)
    sys.stdin.read()
    server.stop()
