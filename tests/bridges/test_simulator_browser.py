"""The simulator's page in a real browser: what is drawn and told, and no error."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import pytest

from bridges.clock import RealClock
from bridges.messages import STOP, Command
from bridges.simulation.process import SimTurtleBotConfig, simulate
from bridges.transports.memory import MemoryLink, pair
from tests.browser import (
    SIZES,
    assert_no_scrolling_sideways,
    browser,
    needs_chromium,
    set_size,
)

pytestmark = needs_chromium
LIMIT = 20.0  # s that nothing here may take


class Simulator(NamedTuple):
    """One that runs on a thread of its own, and a link to it."""

    link: MemoryLink
    url: str
    stop: Callable[[], None]


@contextmanager
def simulator(port: int = 0, **settings: Any) -> Iterator[Simulator]:
    config = SimTurtleBotConfig(view=port, status_every=None, **settings)
    clock, over, said = RealClock(config.speed), threading.Event(), list[str]()
    link, end = pair(clock)
    end.open()
    arguments = (config, end, clock, over.is_set, said.append)
    thread = threading.Thread(target=simulate, args=arguments, daemon=True)

    def stop() -> None:
        over.set()
        thread.join(LIMIT)

    thread.start()
    try:
        until(lambda: len(said) == 2)
        link.open()
        yield Simulator(link, said[1].removeprefix("page: "), stop)
    finally:
        stop()
        link.close()
        end.close()


def drive(link: MemoryLink, command: Command | None, there: Callable[[float], bool]) -> None:
    """Sends a command, if any, and waits until odometry's x is as wanted."""
    if command is not None:
        link.send(command)
    until(lambda: any(there(odometry.x) for odometry in link.take()))


def until(true: Callable[[], Any]) -> None:
    """Waits until something is true."""
    late = time.monotonic() + LIMIT
    while not true():
        assert time.monotonic() < late, "it never came"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The browser, for all tests."""
    with browser(tmp_path_factory.mktemp("browser")) as driver:
        yield driver


@pytest.fixture
def page(request: pytest.FixtureRequest, chromium: Any) -> Iterator[Any]:
    """The browser's window, a phone's if not said; at the end the console must hold no word."""
    width = set_size(chromium, getattr(request, "param", "phone"))
    yield chromium
    assert chromium.get_log("browser") == []
    assert_no_scrolling_sideways(chromium, width)
    chromium.get("about:blank")


def text(page: Any, name: str) -> str:
    return str(page.execute_script(f"return document.getElementById('{name}').textContent"))


def number(text: str) -> str:
    return text.removesuffix(" m").replace("\u2212", "-")


def pixels(page: Any, color: str) -> int:
    """How many of the canvas's pixels have a color of the page's style, nearly."""
    script = """
    const [name] = arguments, {width, height} = document.getElementById("canvas");
    const copy = new OffscreenCanvas(width, height).getContext("2d", {willReadFrequently: true});
    copy.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(name);
    copy.fillRect(0, 0, 1, 1);
    const [r, g, b] = copy.getImageData(0, 0, 1, 1).data;
    copy.clearRect(0, 0, 1, 1);
    copy.drawImage(document.getElementById("canvas"), 0, 0);
    const all = copy.getImageData(0, 0, width, height).data;
    let count = 0;
    for (let i = 0; i < all.length; i += 4)
      if (all[i + 3] > 250 && [r, g, b].every((value, k) => Math.abs(all[i + k] - value) < 6))
        count++;
    return count;
    """
    return int(page.execute_script(script, color))


@pytest.mark.parametrize("page", SIZES, indirect=True)
def test_the_page_follows_a_drive(page: Any) -> None:
    with simulator(speed=2.0, drift=0.5, command_timeout=4.0) as running:
        page.get(running.url)
        until(lambda: text(page, "words") == "no bridge seen")
        assert text(page, "distance") == "2.24 m away"  # from (0, 0) to (2, 1)
        assert "2 simulated s in one of ours, drift +0.50 rad/s" in text(page, "about")
        until(lambda: pixels(page, "--zone") > 20)  # the frame of the goal's square
        assert pixels(page, "--nobody") > 50  # the robot
        before = pixels(page, "--path")

        running.link.send(Command(0.2, -0.12))
        until(lambda: text(page, "words") == "driving")
        assert (text(page, "told-linear"), text(page, "told-angular")) == ("+0.20", "\u22120.12")
        until(lambda: text(page, "is-angular") == "+0.38")
        until(lambda: text(page, "words") == "stopped by its command timeout")
        until(lambda: pixels(page, "--timeout") > 50)
        assert pixels(page, "--path") > before + 30
        # 0.8 m in 4 s, in an arc that is turned through 1.52 rad (and a little for the ramps)
        x, y = (float(number(word)) for word in text(page, "place").split(","))
        assert (x, y) == pytest.approx((0.526, 0.5), abs=0.04)

        running.link.send(STOP)
        until(lambda: text(page, "words") == "told to stand")
        running.link.request_reset()
        until(lambda: text(page, "episode") == "2")
        until(lambda: text(page, "place") == "+0.00, +0.00 m")


def test_a_page_that_opens_late_shows_what_was(page: Any) -> None:
    with simulator(speed=20.0, position_noise=0.05, command_timeout=None) as running:
        for _ in range(2):
            drive(running.link, Command(0.22, 0.1), lambda x: x > 0.8)
            running.link.request_reset()
            drive(running.link, None, lambda x: x < 0.4)
        drive(running.link, Command(0.22, -0.1), lambda x: x > 0.8)
        running.link.send(STOP)
        page.get(running.url)
        until(lambda: text(page, "episode") == "3")
        until(lambda: pixels(page, "--path") > 50)
        assert page.execute_script("return scene.earlier.length") == 2
        assert page.execute_script("return scene.earlier[0].length") > 20
        assert page.execute_script("return path[5].length") == 4  # with odometry beside it
        assert pixels(page, "--told") > 20
        assert page.execute_script("return !document.getElementById('told-legend').hidden")


def test_a_fault_is_told(page: Any) -> None:
    with simulator(speed=4.0, fault="nan", fault_after=0.5, command_timeout=None) as running:
        page.get(running.url)
        until(lambda: text(page, "words") == "no bridge seen")
        running.link.send(Command(0.2, 0.0))
        until(lambda: text(page, "words") == "driving; fault in odometry: nan")
        until(lambda: text(page, "odometry") == "no numbers")
        until(lambda: pixels(page, "--fault") > 50)


def test_a_lost_connection_is_told_and_found_again(page: Any) -> None:
    with simulator() as running:
        page.get(running.url)
        until(lambda: text(page, "words") == "no bridge seen")
        port = int(running.url.strip("/").split(":")[-1])
        running.stop()
        until(lambda: text(page, "words").startswith("no connection to the simulator; what is"))
        assert page.execute_script("return document.body.className") == "lost"
    with simulator(port):
        until(lambda: text(page, "words") == "no bridge seen")
        assert page.execute_script("return document.body.className") == ""
    log = page.get_log("browser")  # the browser's own words on a server that is not there
    assert all("events" in line["message"] for line in log)
