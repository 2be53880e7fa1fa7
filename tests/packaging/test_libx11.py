"""SAPIEN is imported where X11 is not installed."""

import ctypes
import os
import subprocess
import sys

import pytest

from collector.sim import libx11

WITHOUT_X11 = """
import ctypes, os, sys
from collector.sim import libx11

found = ctypes.CDLL
flags = sys.getdlopenflags()


def absent(name, *args, **kwargs):
    if name == libx11.NAME:
        raise OSError(f"{name}: cannot open shared object file")
    return found(name, *args, **kwargs)


ctypes.CDLL = absent
libx11.NAME = "libAbsent.so.6"
with libx11.without_x11():
    assert sys.getdlopenflags() == os.RTLD_LAZY
    ctypes.CDLL = found
    ctypes.CDLL(libx11.NAME)  # A library that names it as one that it needs would find it now.
assert sys.getdlopenflags() == flags
"""


def test_an_empty_library_is_found_by_its_name() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_X11], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_empty_library_has_no_functions() -> None:
    file = os.memfd_create("empty")
    os.write(file, libx11.empty_library("libNothing.so.1"))
    library = ctypes.CDLL(f"/proc/self/fd/{file}")
    os.close(file)
    with pytest.raises(AttributeError):
        _ = library.XOpenDisplay


def test_sapien_simulates_after_an_import_without_x11() -> None:
    script = """
import ctypes
from collector.sim import libx11

found = ctypes.CDLL
# The first question, whether X11 is there, is answered by no; the empty library then takes its place.
ctypes.CDLL = lambda name, *args, **kwargs: (
    found(name, *args, **kwargs) if name != libx11.NAME else (_ for _ in ()).throw(OSError(name))
)
from collector.sim.engine import new_scene

_, system = new_scene(20)
system.step()
print(sum("libX11" in line for line in open("/proc/self/maps")))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_renderer_that_calls_x11_is_refused_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    from collector.sim import sapien_camera

    monkeypatch.setattr(libx11, "is_installed", lambda: False)
    sapien_camera.why_unavailable.cache_clear()
    try:
        assert sapien_camera.why_unavailable().endswith("on Debian, libx11-6")
    finally:
        sapien_camera.why_unavailable.cache_clear()
