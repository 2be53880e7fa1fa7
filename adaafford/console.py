"""The command `adaafford`.

It begins here, where it is seen first that nothing shadows our packages, and not in the package of the command line,
since `cluster` is a name that others have, too. That package is not imported statically: whoever uses this one in
Python needs none of it.
"""

import sys
from importlib import import_module
from typing import NoReturn


def main() -> NoReturn:
    """Run the command line of this process and exit."""
    try:
        import_module("cluster.cli.main").main()
    except KeyboardInterrupt:
        # While it was imported, before it heeds signals; nothing was begun.
        print("adaafford: interrupted", file=sys.stderr)
        sys.exit(130)
    raise AssertionError("the command line ends the process")


if __name__ == "__main__":
    main()
