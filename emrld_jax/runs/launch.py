"""Processes on this machine that train together, each on its share of the cores."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from types import FrameType

from emrld_jax.runs.config import ConfigError

# large pages for large arrays, as glibc's malloc can ask for: an eighth less time for a meta-step
HUGE_PAGES = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}
GRACE_S = 30  # that processes have to end by themselves once one has failed


def launch(arguments: Sequence[str], processes: int) -> int:
    """Starts the command once for each process, and waits; signals are passed on to the first.

    Args:
        arguments: of `emrld_jax.train`.
        processes: how many.

    Returns:
        The exit code: of the process that failed first, else of the first process.

    Raises:
        ConfigError: there are not as many cores.
    """
    shares = _shares(processes)
    others = [text for text in arguments if text.partition("=")[0] != "processes"]
    together = [
        f"distributed.coordinator={_free_address()}",
        f"distributed.num_processes={processes}",
    ]
    command = [sys.executable, "-m", "emrld_jax.train", *others, *together]
    environment = HUGE_PAGES | os.environ
    children = []
    for i, cores in enumerate(shares):
        os.sched_setaffinity(0, cores)  # which the child inherits
        out = None if i == 0 else subprocess.DEVNULL
        own = [*command, f"distributed.process_id={i}"]
        child = subprocess.Popen(
            own, env=environment, stdout=out, stderr=out, start_new_session=True
        )
        children.append(child)
    os.sched_setaffinity(0, set().union(*shares))
    with _Forwarding(children):
        return _wait(children)


def _shares(processes: int) -> list[set[int]]:
    """The cores of each process, as equal as they can be."""
    if not hasattr(os, "sched_getaffinity"):
        raise ConfigError(f"processes={processes} needs Linux, which can bind processes to cores")
    cores = sorted(os.sched_getaffinity(0))
    if processes > len(cores):
        raise ConfigError(
            f"processes={processes} is not allowed: this machine has {len(cores)} core(s) for them"
        )
    return [set(cores[i::processes]) for i in range(processes)]


def _free_address() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def _wait(children: Sequence[subprocess.Popen]) -> int:
    while all(child.poll() in (None, 0) for child in children):
        if all(child.poll() == 0 for child in children):
            return 0
        time.sleep(0.05)
    failed = next(child for child in children if child.poll() not in (None, 0))
    deadline = time.monotonic() + GRACE_S
    for child in children:
        try:
            child.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
    code = children[0].returncode or failed.returncode
    return code if code > 0 else 128 - code


class _Forwarding:
    """Passes a first signal on to the first process, which stops them all; a second one to all."""

    def __init__(self, children: Sequence[subprocess.Popen]) -> None:
        self._children, self._received = children, 0

    def __enter__(self) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._pass_on)

    def __exit__(self, *_: object) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self._received += 1
        for child in self._children[: 1 if self._received == 1 else None]:
            if child.poll() is None:
                child.send_signal(number)
