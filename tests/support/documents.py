"""Reading the documents of a store, so that a test can change them."""

from typing import Any

from shared.io.documents import checked_content, parse_object


def without_checksum(data: bytes, source: str) -> dict[str, Any]:
    """The content of a document that `with_checksum` wrote.

    Raises:
        StoreError: it is not JSON, not an object, or not what was sealed, byte for byte.
    """
    return checked_content(parse_object(data, source), data, source)
