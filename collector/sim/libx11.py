"""Let SAPIEN be imported on a machine without X11.

SAPIEN's native library names `libX11.so.6` as a library that it needs, although it calls nothing of it here, where no
window is opened. Servers and slim images do not have that library. An empty one of the same name, made in memory, is
enough for the dynamic linker as long as missing functions are looked up when they are called and not before. A process
that calls one, as SAPIEN's renderer does, is ended by the linker; so the renderer asks `is_installed` first.
"""

import ctypes
import os
import platform
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

NAME = "libX11.so.6"

_HEADERS = 64 + 3 * 56
"""Bytes before the tables: the file's header and three program headers."""
_X86_64 = 62


@cache
def is_installed() -> bool:
    """Whether this machine has the library itself; to be asked before SAPIEN is imported for the first time."""
    try:
        ctypes.CDLL(NAME)
    except OSError:
        return False
    return True


@contextmanager
def without_x11() -> Iterator[None]:
    """Import a library that names X11 inside this context; does nothing where X11 is installed."""
    if is_installed():
        yield
        return
    if sys.platform == "linux" and platform.machine() == "x86_64":
        _load(empty_library(NAME))
    flags = sys.getdlopenflags()
    sys.setdlopenflags(os.RTLD_LAZY)
    try:
        yield
    finally:
        sys.setdlopenflags(flags)


def _load(content: bytes) -> None:
    """Load a shared library from memory; the linker then knows its name."""
    file = os.memfd_create(NAME)
    try:
        with open(file, "wb", closefd=False) as library:
            library.write(content)
        ctypes.CDLL(f"/proc/self/fd/{file}", mode=ctypes.RTLD_GLOBAL)
    finally:
        os.close(file)


def empty_library(name: str) -> bytes:
    """A shared library (ELF, x86-64) of that name without symbols.

    It has three program headers, which map the file, name its dynamic section and say that no stack is executed. It has
    the tables that the linker insists on: strings, symbols (the empty one alone) and their hashes.
    """
    strings = b"\0" + name.encode() + b"\0"
    symbols = bytes(24)
    hashes = struct.pack("<4I", 1, 1, 0, 0)  # One bucket and one chain, both of which end at the empty symbol.
    at_symbols = _HEADERS
    at_hashes = at_symbols + len(symbols)
    at_dynamic = at_hashes + len(hashes)
    entries = 7
    at_strings = at_dynamic + entries * 16
    end = at_strings + len(strings)
    own_name, string_table, symbol_table, string_size, symbol_size, hash_table = 14, 5, 6, 10, 11, 4
    dynamic = struct.pack(
        "<14Q",
        *(own_name, 1),  # The library's own name, by its place among the strings.
        *(hash_table, at_hashes),
        *(string_table, at_strings),
        *(symbol_table, at_symbols),
        *(string_size, len(strings)),
        *(symbol_size, len(symbols)),
        *(0, 0),
    )
    identity = b"\x7fELF" + bytes([2, 1, 1]) + bytes(9)  # 64 bits, little-endian, version 1.
    header = identity + struct.pack("<HHIQQQIHHHHHH", 3, _X86_64, 1, 0, 64, 0, 0, 64, 56, 3, 64, 0, 0)
    load = struct.pack("<IIQQQQQQ", 1, 6, 0, 0, 0, end, end, 0x1000)
    section = struct.pack("<IIQQQQQQ", 2, 6, at_dynamic, at_dynamic, at_dynamic, len(dynamic), len(dynamic), 8)
    # Without this header, a stack that can be executed is asked for, which newer systems refuse.
    stack = struct.pack("<IIQQQQQQ", 0x6474E551, 6, 0, 0, 0, 0, 0, 16)
    return header + load + section + stack + symbols + hashes + dynamic + strings
