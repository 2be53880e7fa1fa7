"""`adaafford version`."""

from importlib.metadata import version

from shared.errors import UsageError


def main(args: list[str]) -> int:
    """Print the version."""
    if args:
        raise UsageError(f"version takes no arguments; given: {' '.join(args)}")
    print(version("adaafford"))
    return 0
