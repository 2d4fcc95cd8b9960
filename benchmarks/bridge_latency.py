"""How long a command takes to a robot's process and its odometry back, on this machine.

`python -m benchmarks.bridge_latency transport=dds` measures back to back (the next command as soon
as odometry is there) and at a steady rate, with an echoing robot in a process of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version

import numpy as np

from benchmarks.choice import origin
from benchmarks.loopback import stay_here
from benchmarks.records import write_record
from bridges.clock import RealClock
from bridges.command_line import configured, run_command
from bridges.messages import Command
from bridges.transports import choice
from bridges.transports.base import LinkSettings, RobotLink, TransportError
from emrld_jax.fields import setting

_QUANTILES = (0, 10, 50, 90, 99, 100)  # percent
_LIMIT = 5.0  # s that an answer may take


@dataclass
class LatencyConfig:
    """All settings of the measurement."""

    transport: str = setting("dds", "of both ends", choices=("dds", "rclpy"))
    samples: int = setting(1000, "round trips of each kind", at_least=10)
    warm_up: int = setting(100, "round trips before them that do not count", at_least=1)
    rate: float = setting(50.0, "commands a s of the steady kind", above=0)
    domain_id: int = setting(77, "ROS domain that nobody else uses", at_least=0, at_most=101)


@contextmanager
def robot(config: LatencyConfig) -> Iterator[None]:
    """An echoing robot in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.echo_robot"]
    with subprocess.Popen(
        [*command, config.transport, str(config.domain_id)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            raise TransportError("the echoing robot did not start; see above")
        yield
        # leaving closes its input, which ends it


def round_trips(link: RobotLink, number: int, rate: float | None) -> np.ndarray:
    """Times of round trips in s; at a rate, or back to back."""
    times = np.empty(number)
    due = time.monotonic()
    for i in range(number):
        if rate is not None:
            due += 1 / rate
            time.sleep(max(0.0, due - time.monotonic()))
        link.take()
        began = time.perf_counter()
        link.send(Command(float(i), 0.0))
        if not link.wait(_LIMIT):
            raise TransportError(f"no odometry answered command {i} within {_LIMIT:g} s")
        times[i] = time.perf_counter() - began
    return times


def middleware(transport: str) -> str:
    """What carries the messages, and its version where it has one of its own."""
    if transport == "dds":
        return f"cyclonedds {version('cyclonedds')}"
    return str(import_module("rclpy").get_rmw_implementation_identifier())


def main() -> int:
    """Measures and writes."""
    config = configured(
        "benchmarks.bridge_latency",
        "Measures the round trip from a command to odometry between two processes.",
        ["transport=dds", "transport=rclpy samples=5000"],
        LatencyConfig(),
    )
    if config is None:
        return 0
    stay_here()
    link = choice.link(config.transport, LinkSettings(config.domain_id), RealClock())
    measured: dict[str, np.ndarray] = {}
    with robot(config):
        try:
            link.open()
            for what, rate in (
                ("back to back", None),
                (f"at {config.rate:g} Hz", config.rate),
            ):
                round_trips(link, config.warm_up, None)
                measured[what] = 1e3 * round_trips(link, config.samples, rate)
        finally:
            link.close()
    lines = ["| command to odometry | median | p99 | |", "|---|---|---|---|"]
    lines += [
        f"| {config.transport}, {what} | {np.median(ms):.3g} | {np.percentile(ms, 99):.3g} | ms |"
        for what, ms in measured.items()
    ]
    record = {
        **origin("bridge_latency"),
        "middleware": middleware(config.transport),
        "samples": config.samples,
        "load_average": list(os.getloadavg()),
        "rows": [
            {"what": what, "unit": "ms", "quantiles": dict(zip(_QUANTILES, values, strict=True))}
            for what, ms in measured.items()
            for values in [np.percentile(ms, _QUANTILES).tolist()]
        ],
    }
    write_record(f"bridge_latency-{config.transport}", record, "\n".join(lines))
    return 0


if __name__ == "__main__":
    run_command(main)
