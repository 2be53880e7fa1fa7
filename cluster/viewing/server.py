"""A server of viser for this machine's own browsers, and text that is safe in its page."""

import html
import io
import os
import re
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import partial
from typing import Any

import numpy as np
import viser
import websockets.asyncio.server
from viser import _messages

from shared.errors import AdaAffordError, UsageError
from shared.io.text import plain
from shared.types import Action, Float

HOST = "127.0.0.1"
STOP_S = 20.0
_OWN_PAGES = re.compile(r"https?://(127\.0\.0\.1|localhost|\[::1\])(:\d+)?")
"""Origins whose scripts may talk to the server: its own page, perhaps through a forwarded port."""
SUCCESS, FAILURE, FORWARD = (34, 139, 60), (200, 30, 40), (40, 90, 220)
FIELD_OF_VIEW_RAD, NEARNESS = 0.8, 1.6
"""Of the eye; and its distance from an object, as a multiple of the object's size."""


@contextmanager
def serving(port: int) -> Iterator[viser.ViserServer]:
    """A running server on the loopback interface, which stops at the end.

    Pages of other sites are refused, and so is the page's offer to share itself through a server on the internet.

    Args:
        port: 0 chooses a free one.

    Raises:
        UsageError: the port is in use, or may not be used.
    """
    _check_free(port)
    os.environ.pop("_VISER_PORT_OVERRIDE", None)
    serve = websockets.asyncio.server.serve
    # viser has no parameter for this, and reads the name when it starts.
    module: Any = websockets.asyncio.server
    module.serve = partial(serve, origins=[_OWN_PAGES, None])
    try:
        with redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=HOST, port=port, label="AdaAfford", verbose=False)
    finally:
        module.serve = serve
    try:
        for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            server._websock_server.unregister_handler(message)
        if port and server.get_port() != port:
            raise _in_use(port)
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.gui.main_panel.dock_right()
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()
            # It waits for a second, but its thread says something at its very end.
            if (thread := server._websock_server._server_thread) is not None:
                thread.join(STOP_S)


def _check_free(port: int) -> None:
    """Refuse a port that is taken; viser would take another one."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError:
            raise _in_use(port) from None


def _in_use(port: int) -> UsageError:
    return UsageError(f"port {port} of {HOST} cannot be used; give another by --port, or 0 for a free one")


def text(value: object, most: int | None = None) -> str:
    """Text from outside as HTML, in which nothing is a tag."""
    return html.escape(plain(value, most))


def small(value: str) -> str:
    """Lines of text from outside as a small paragraph in HTML."""
    lines = "<br>".join(text(line) for line in value.split("\n"))
    return f'<p style="margin:0.3em 1em;font-size:0.8em;line-height:1.35">{lines}</p>'


class Page:
    """What all pages have in common: one callback at a time, errors as a line, actions as arrows."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self.lock = threading.RLock()
        self._quiet: int | None = None
        self.status = server.gui.add_html("")

    def on(self, *handles: Any, call: Callable[[], None], alone: bool = True) -> None:
        """Call something when a person uses one of some controls.

        Args:
            handles: inputs or buttons.
            call: what to do; its errors are shown as a line.
            alone: whether other callbacks wait until it is done.
        """

        def guarded(_: object) -> None:
            if self._quiet == threading.get_ident():
                return
            try:
                if not alone:
                    call()
                    return
                with self.lock:
                    self.say("")
                    call()
            except AdaAffordError as error:
                self.say(str(error), wrong=True)

        for handle in handles:
            (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(guarded)

    @contextmanager
    def silently(self) -> Iterator[None]:
        """Set values of controls without calling back."""
        # Values that we set call back in this thread; those of a person, in another one.
        before, self._quiet = self._quiet, threading.get_ident()
        try:
            yield
        finally:
            self._quiet = before

    def say(self, line: str, *, wrong: bool = False) -> None:
        """Show a line above the controls."""
        colour = "#b01020" if wrong else "#405060"
        self.status.content = f'<div style="color:{colour}">{small(line)}</div>' if line else ""

    def put(self, handle: Any, value: object) -> None:
        """Give a control a value, and call back what listens to it unless this is done `silently`."""
        handle.value = value

    def choose(self, dropdown: Any, options: Sequence[str]) -> None:
        """Give a dropdown other options, and choose the first."""
        dropdown.options = tuple(options)
        dropdown.value = options[0]

    def span(self, slider: Any, low: int, high: int, value: int) -> None:
        """Give a slider another range."""
        # A slider needs two values.
        slider.min, slider.max = low, max(high, low + 1)
        slider.disabled = high <= low
        slider.value = value

    def look_at(self, middle: Float, away: Float, size: float) -> None:
        """Let all browsers look at an object of some size from a direction."""
        place = middle + NEARNESS * size * away / np.linalg.norm(away)
        cameras: list[Any] = [client.camera for client in self.server.get_clients().values()]
        self.server.initial_camera.fov = FIELD_OF_VIEW_RAD
        for camera in [self.server.initial_camera, *cameras]:
            camera.position, camera.look_at = place, middle

    def arrows(
        self, name: str, actions: Sequence[Action], colours: Sequence[tuple[int, int, int]], size: float
    ) -> None:
        """Draw actions as arrows along their approach, with the head where the hand touches."""
        ends = [[action.point - size * action.approach, action.point] for action in actions]
        self.vectors(name, np.array(ends).reshape(-1, 2, 3), np.array(colours).reshape(-1, 3), size)

    def vectors(self, name: str, ends: Float, colours: Any, size: float) -> None:
        """Draw arrows from tail to head, [arrows, 2, 3]; none removes them."""
        if not len(ends):
            self.server.scene.remove_by_name(name)
            return
        self.server.scene.add_arrows(
            name,
            ends,
            np.asarray(colours, np.uint8),
            shaft_radius=0.03 * size,
            head_radius=0.08 * size,
            head_length=0.25 * size,
        )
