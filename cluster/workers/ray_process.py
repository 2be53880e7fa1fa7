"""Runs in place of the Python programs that Ray's raylet starts: a worker starts faster, and agents only wait.

    python ray_process.py PROGRAM ARGUMENTS

This is a script, which imports nothing of ours: `cluster.workers.session` puts its path before that of Ray's program.
"""

import os
import runpy
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

WORKER = "default_worker.py"
SLOW = ("rfc3987_syntax", "rfc3986_validator", "uri_template", "isoduration")
"""Optional packages of jsonschema, which Ray imports, and uses for none of their formats: the first compiles a grammar
for 1.3 s of processor time, whenever it is imported."""


def main() -> None:
    """Run Ray's program if it is a worker; if it is an agent, wait for the end of the raylet."""
    del sys.argv[0]  # As Ray's program would see it.
    folder, name = os.path.split(sys.argv[0])
    if name == WORKER:
        sys.path[0] = folder
        with without_slow_imports():
            import ray  # noqa: F401
        runpy.run_path(sys.argv[0], run_name="__main__")
    else:
        wait_for_raylet()


@contextmanager
def without_slow_imports() -> Iterator[None]:
    """Within this context, imports of `SLOW` fail as if not installed; what is imported already stays."""
    hidden = [name for name in SLOW if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


def wait_for_raylet() -> None:
    """Wait until the raylet ends, which started this process; it exits as soon as one of its agents does."""
    raylet = int(os.environ["RAY_RAYLET_PID"])
    while os.getppid() == raylet:
        time.sleep(1)


if __name__ == "__main__":
    main()
