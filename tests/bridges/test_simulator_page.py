"""What the server of the simulator's page tells, and how it begins and ends."""

from __future__ import annotations

import http.client
import json
import math
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import pytest

from bridges.messages import STOP, BridgeError, Odometry
from bridges.simulation.settings import SimulatedRobotSettings
from bridges.simulation.state import State
from bridges.simulation.trace import MOST_PATHS, MOST_POINTS, STEP, Trace
from bridges.simulation.view import View, ViewSettings

LIMIT = 20.0  # s that nothing here may take

AT_START = State(
    *(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False, STOP, None, False, 0.0, None, None, 0),
)


@contextmanager
def view(speed: float = 1.0, **settings: Any) -> Iterator[View]:
    """A page's server, at any port."""
    made = View(ViewSettings(view=0, **settings), SimulatedRobotSettings(), speed)
    try:
        yield made
    finally:
        made.close()
        made.close()


@contextmanager
def connected(address: str, path: str) -> Iterator[http.client.HTTPResponse]:
    host, port = address.removeprefix("http://").strip("/").split(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=LIMIT)
    connection.request("GET", path)
    try:
        yield connection.getresponse()
    finally:
        connection.close()


def event(stream: http.client.HTTPResponse) -> tuple[str, Any]:
    """The next event of a stream, and what it says."""
    while not (name := stream.readline().decode()).startswith("event: "):
        assert name  # the stream goes on
    data, blank = (stream.readline().decode() for _ in range(2))
    assert blank == "\n"

    def refuse(constant: str) -> Any:
        raise ValueError(f"{constant} is no JSON")

    content = json.loads(data.removeprefix("data: "), parse_constant=refuse)
    return name.removeprefix("event: ").strip(), content


def test_a_page_is_told_the_scene_and_then_what_is_new() -> None:
    with view(speed=10.0, goal=[1.0, 0.5], arena=None) as server:
        server.show(AT_START)
        server.show(AT_START._replace(x=0.1))
        with connected(server.url, "/events") as stream:
            assert stream.getheader("Content-Type") == "text/event-stream"
            name, scene = event(stream)
            assert name == "scene"
            assert (scene["goal"], scene["arena"], scene["speed"]) == ([1.0, 0.5], None, 10.0)
            assert scene["limits"] == [0.22, 2.84]
            assert scene["path"] == [[0.0, 0.0], [0.1, 0.0]]
            name, frame = event(stream)
            assert (name, frame["points"], frame["mood"]) == ("frame", [], "nobody")
            told = Odometry(3.0, 3.0, math.nan, 0.1, 0.2, 0.0, 0.0)
            server.show(AT_START._replace(x=0.2, told=told, fault="nan", moment=3.0))
            _, frame = event(stream)
            assert frame["points"] == [[0.2, 0.0, None, 0.1]]
            assert frame["told"] == [None, 0.1, 0.2]
            assert (frame["moment"], frame["words"]) == (
                3.0,
                "no bridge seen; fault in odometry: nan",
            )
            server.show(AT_START._replace(resets=1))
            name, scene = event(stream)
            assert name == "scene"
            assert scene["earlier"] == [[[0.0, 0.0], [0.1, 0.0], [0.2, 0.0, None, 0.1]]]
            assert scene["path"] == [[0.0, 0.0]]
            assert event(stream)[1]["episode"] == 2


def test_the_server_has_a_page_and_nothing_else() -> None:
    with view() as server:
        assert server.url.startswith("http://127.0.0.1:")
        with connected(server.url, "/") as response:
            page = response.read().decode()
            assert response.status == 200
        assert page.startswith("<!doctype html>")
        assert "//" not in page.replace("// ", "")  # no address of anything else
        for path in ("/page.html", "/../settings.py", "/events?x", "/favicon.ico"):
            with connected(server.url, path) as response:
                assert response.status == 404


def test_a_stream_ends_with_its_view() -> None:
    with view() as server:
        server.show(AT_START)
        with connected(server.url, "/events") as stream:
            event(stream)
            event(stream)
            server.close()
            assert stream.read() == b""


def test_the_next_free_port_is_taken() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        server = View(ViewSettings(view=port), SimulatedRobotSettings(), 1.0)
        server.close()
    assert port < int(server.url.strip("/").split(":")[-1]) < port + 10


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"goal": [1.0]}, r"goal=\[1\] is not allowed: it must be \[x, y\]"),
        ({"view_host": "192.0.2.1"}, "view_host=192.0.2.1: no page can be offered there"),
        ({"view_host": "no such host"}, "view_host=no such host: no page can be offered there"),
    ],
)
def test_what_is_wrong_with_the_page_is_told(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(BridgeError, match=words), view(**settings):
        pass


def test_a_path_has_points_apart_and_not_too_many() -> None:
    trace = Trace(noisy=False)
    for i in range(2 * MOST_POINTS):
        trace.add(AT_START._replace(x=i * STEP * 1.01))
        trace.add(AT_START._replace(x=i * STEP * 1.01 + 0.9 * STEP))
    xs = [float(point[0] or 0.0) for point in trace.path]
    assert MOST_POINTS / 2 <= len(xs) <= MOST_POINTS
    assert min(b - a for a, b in pairwise(xs)) >= STEP - 1e-4  # told to the tenth of a mm
    assert xs[0] == 0.0
    assert xs[-1] == pytest.approx((2 * MOST_POINTS - 1) * STEP * 1.01, abs=2 * STEP)
    for i in range(MOST_PATHS + 5):
        for x in (0.0, 0.1 * i + 0.1):
            trace.add(AT_START._replace(x=x, resets=i + 1))
    assert len(trace.earlier) == MOST_PATHS
    assert trace.earlier[-1][-1][0] == pytest.approx(0.1 * (MOST_PATHS + 4))
