"""A session and its page, from the first browser to the last."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
import threading
import time
from typing import Any

import viser

from d4orm_env.core.problem import Problem
from d4orm_planners.play.origin_check import LOOPBACK, OriginCheck
from d4orm_planners.play.panel import THEME, Panel
from d4orm_planners.play.proxy import AuthenticatingProxy
from d4orm_planners.play.session import Session
from d4orm_planners.play.view import View

FRAMES_PER_SECOND = 33
LAST_WAIT = 1.5
"""Seconds that closing takes at most, whatever is planned or connected."""


class _Server(viser.ViserServer):
    """A page that cannot be asked to open a tunnel to the internet."""

    def request_share_url(self, verbose: bool = True) -> None:
        del verbose


class Playground:
    """A page that shows a session, and lets its viewers change it.

    Args:
        problem: The scene to begin with.
        policies: Names of what drives, side by side; D4orm-C2F by default.
        seed: Of the policies, of what goes wrong, and of new goals.
        host: Address of the page; by default on this machine only. Elsewhere the address has a token.
        port: Port of the page; 0 for any free one.
        **observation: Arguments of :class:`d4orm_env.navigation_v0.parallel_env` on what robots observe.

    Attributes:
        address: Address to open in a browser.
        session: Session that it shows.

    Raises:
        ValueError: If it cannot be found there, or there is no such policy.
    """

    def __init__(
        self,
        problem: Problem,
        *policies: str,
        seed: int = 0,
        host: str = LOOPBACK[0],
        port: int = 0,
        **observation: Any,
    ) -> None:
        local = host in LOOPBACK
        chosen = _free_port(host, port)
        self.session = Session(problem, *policies, seed=seed, **observation)
        with contextlib.redirect_stdout(io.StringIO()):  # its own words on where it is
            self._server = _Server(
                host="127.0.0.1", port=chosen if local else _free_port("127.0.0.1", 0), verbose=False
            )
        self._gate = None if local else AuthenticatingProxy(host, chosen, self._server.get_port())
        # Otherwise Python prints every request that cannot be read, which anybody can make.
        logging.getLogger("websockets").addHandler(logging.NullHandler())
        OriginCheck(self._server, None if self._gate is None else self._gate.token, self.session.refuse)
        if self._gate is None:
            self.address = f"http://127.0.0.1:{self._server.get_port()}/"
        else:
            named = socket.gethostname() if host in ("0.0.0.0", "::") else host
            self.address = f"http://{named}:{self._gate.port}/?token={self._gate.token}"
        self._server.scene.configure_default_lights(enabled=False)
        self._server.scene.add_light_ambient("/light", intensity=1.1)
        self._server.scene.add_light_directional("/sun", intensity=0.5, position=(-1.0, -0.5, 2.0))
        self._server.gui.configure_theme(**THEME)
        self._server.gui.set_panel_label("d4orm play")
        self._view = View(self._server, self.session)
        self._panel = Panel(self._server, self.session, self._view)
        self._stopping = threading.Event()

    def run(self, seconds: float | None = None) -> None:
        """Show the session until Ctrl-C or :meth:`stop`, or for so long.

        Raises:
            BaseException: The error that ended the session, if any.
        """
        end = None if seconds is None else time.perf_counter() + seconds
        self.session.start()
        due = time.perf_counter()
        while not self._stopping.is_set() and (end is None or time.perf_counter() < end):
            if self.session.failure is not None:
                raise self.session.failure
            self.show()
            due = max(due + 1 / FRAMES_PER_SECOND, time.perf_counter())
            time.sleep(max(due - time.perf_counter(), 0.001))

    def stop(self) -> None:
        """Let :meth:`run` come to its end."""
        self._stopping.set()

    @property
    def clients(self) -> dict[int, viser.ClientHandle]:
        """Clients that look at the page, by number."""
        return self._server.get_clients()

    def show(self) -> None:
        """Bring the page up to date."""
        self._view.update()
        self._panel.update()

    def close(self) -> None:
        """Leave no thread and no port, but for what does not end in :data:`LAST_WAIT`, which the process's end ends."""
        ends = [self.session.close, self._server.stop, *([] if self._gate is None else [self._gate.close])]
        ending = [threading.Thread(target=end, daemon=True) for end in ends]
        deadline = time.perf_counter() + LAST_WAIT
        for thread in ending:
            thread.start()
        for thread in ending:
            thread.join(max(deadline - time.perf_counter(), 0))


def _free_port(host: str, port: int) -> int:
    """Return that port, or any that is free for 0.

    Raises:
        ValueError: If it is taken, or the host is not one of this machine's.
    """
    if not host:  # which would be every address
        raise ValueError(
            "cannot listen at no host; give --host an address, as 127.0.0.1, or 0.0.0.0 for all of this machine's"
        )
    try:
        with socket.create_server((host, port)) as listening:
            return int(listening.getsockname()[1])
    except (OSError, OverflowError, TypeError) as error:  # a name that is none is a TypeError
        raise ValueError(f"cannot listen at {host} port {port} ({error}); choose another --host or --port") from None
