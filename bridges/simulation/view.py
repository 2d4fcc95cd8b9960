"""A page that shows a simulated robot live: a small server, which only tells and takes nothing."""

from __future__ import annotations

import errno
import json
import threading
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import TCPServer
from typing import Any, NamedTuple

from bridges.messages import BridgeError
from bridges.simulation.settings import SimulatedRobotSettings, of_length
from bridges.simulation.state import State
from bridges.simulation.trace import Trace, number
from emrld_jax.fields import setting

PAGE = Path(__file__).with_name("page.html")
PORTS_TRIED = 10


@dataclass
class ViewSettings:
    """The page that shows the robot, and what it draws beside it."""

    view: int | None = setting(
        8000,
        "port of the page, or the next free one of ten; 0: any; null: no page",
        at_least=0,
        at_most=65535,
    )
    view_host: str = setting(
        "127.0.0.1", "address that the page is offered at; 0.0.0.0: to the whole network"
    )
    goal: list[float] | None = setting([2.0, 1.0], "x, y in m, for the page; null: none")
    goal_half_width: float = setting(0.1, "m, of the square of success, for the page", at_least=0)
    reward_radius: float = setting(0.5, "m around the goal, for the page", at_least=0)
    arena: float | None = setting(
        2.5, "m: an episode ends where |x| or |y| exceeds it; for the page; null: none", above=0
    )


class _Known(NamedTuple):
    """What an open page has been told."""

    frames: int
    revision: int  # of the trace
    points: int  # of its path


class View:
    """The page's server; it begins at once.

    Args:
        settings: where the page is, and what it draws.
        robot: the robot's settings, for the page's scales.
        speed: simulated seconds in one of ours.

    Raises:
        BridgeError: there is no such address here, or no port is free.
        SettingError: the goal is not two numbers.
    """

    def __init__(self, settings: ViewSettings, robot: SimulatedRobotSettings, speed: float) -> None:
        goal = settings.goal
        self._scene = {
            "goal": None if goal is None else of_length("goal", goal, "x, y"),
            "half_width": settings.goal_half_width,
            "reward_radius": settings.reward_radius,
            "arena": settings.arena,
            "start": robot.start,
            "limits": [robot.max_linear, robot.max_angular],
            "drift": robot.drift,
            "speed": speed,
        }
        self._trace = Trace(noisy=robot.position_noise > 0 or robot.heading_noise > 0)
        self._news = threading.Condition()  # guards all below, and the trace
        self._frame: dict[str, Any] = {}
        self._frames = 0
        self._closed = False
        self._server = _listening(settings, self)
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    @property
    def url(self) -> str:
        """Where the page is."""
        host, port = self._server.server_address[:2]
        return f"http://{host!s}:{port}/"

    def record(self, state: State) -> None:
        """Keeps where the robot is, for its path; to be called oftener than `show`."""
        with self._news:
            self._trace.add(state)

    def show(self, state: State) -> None:
        """Tells every open page."""
        with self._news:
            self._trace.add(state)
            self._frame = frame(state)
            self._frames += 1
            self._news.notify_all()

    def close(self) -> None:
        """Ends the server; may be called twice."""
        with self._news:
            self._closed = True
            self._news.notify_all()
        self._server.shutdown()
        self._server.server_close()

    def stream(self, write: Callable[[bytes], Any]) -> None:
        """Writes what a page is to know until the page or this view is gone."""
        write(b"retry: 500\n\n")  # ms until a page that lost its connection tries again
        known = _Known(frames=0, revision=-1, points=0)
        while (news := self._since(known)) is not None:
            text, known = news
            write(text.encode())

    def _since(self, known: _Known) -> tuple[str, _Known] | None:
        """Waits for what a page does not know yet: the events, and what it knows then."""
        with self._news:
            self._news.wait_for(lambda: self._closed or self._frames != known.frames)
            if self._closed:
                return None
            text, points = "", known.points
            if known.revision != self._trace.revision:
                text += _event("scene", {**self._scene, **self._trace.drawing()})
                points = len(self._trace.path)
            text += _event("frame", {**self._frame, "points": self._trace.path[points:]})
            now = _Known(self._frames, self._trace.revision, len(self._trace.path))
            return text, now


def frame(state: State) -> dict[str, Any]:
    """What a page is told of a moment, in the words of JSON; velocities and poses as lists."""
    told = state.told
    return {
        "moment": round(state.moment, 3),
        "mood": state.mood,
        "words": state.words,
        "pose": [number(state.x, 4), number(state.y, 4), number(state.theta, 4)],
        "velocity": [number(state.linear, 4), number(state.turning, 4)],
        "command": [number(value, 4) for value in state.command],
        "rate": round(state.command_rate, 1),
        "since": None if state.since_command is None else round(state.since_command, 1),
        "told": None if told is None else [number(v, 4) for v in (told.x, told.y, told.theta)],
        "episode": state.resets + 1,
    }


def _event(name: str, content: dict[str, Any]) -> str:
    return f"event: {name}\ndata: {json.dumps(content, allow_nan=False)}\n\n"


class _Server(ThreadingHTTPServer):
    """Binds without asking a name server what its address is called."""

    def __init__(self, address: tuple[str, int], view: View) -> None:
        self.view = view
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        TCPServer.server_bind(self)
        self.server_name, self.server_port = "simulator", self.server_address[1]


class _Handler(BaseHTTPRequestHandler):
    timeout = 10  # s that a page may keep us waiting

    def do_GET(self) -> None:
        match self.path:
            case "/":
                self._answer("text/html; charset=utf-8")
                self.wfile.write(PAGE.read_bytes())
            case "/events":
                self._answer("text/event-stream")
                self._stream()
            case _:
                self.send_error(HTTPStatus.NOT_FOUND)

    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing: the terminal is for the robot."""

    def _answer(self, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

    def _stream(self) -> None:
        assert isinstance(self.server, _Server)
        try:
            self.server.view.stream(self.wfile.write)
        except OSError:  # the page is gone
            return


def _listening(settings: ViewSettings, view: View) -> _Server:
    first = settings.view or 0
    for port in range(first, min(first + PORTS_TRIED, 65536)):
        try:
            return _Server((settings.view_host, port), view)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                where = f"view={settings.view} view_host={settings.view_host}"
                raise BridgeError(f"{where}: no page can be offered there ({error})") from error
    raise BridgeError(
        f"view={settings.view}: this port and the next ones are taken; give another, 0 for any, "
        "or null for no page"
    )
