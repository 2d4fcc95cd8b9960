"""Processes on this machine that train together, each on its share of the cores."""

from __future__ import annotations

import os
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from types import FrameType
from typing import IO

from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.provenance import TYPED

# large pages for large arrays, as glibc's malloc can ask for: an eighth less time for a meta-step
HUGE_PAGES = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}
GRACE_S = 30  # that processes have to end by themselves once one has failed


def launch(arguments: Sequence[str], processes: int) -> int:
    """Starts the command once for each process, and waits; signals are passed on to the first.

    Args:
        arguments: of `emrld_jax.train`.
        processes: how many.

    Returns:
        The exit code of the first process, or if that is 0 of another one that failed.

    Raises:
        ConfigError: there are not as many cores.
    """
    shares = _shares(processes)
    others = [text for text in arguments if text.partition("=")[0] != "processes"]
    coordinator = f"distributed.coordinator={_free_address()}"
    together = [coordinator, f"distributed.num_processes={processes}"]
    command = [sys.executable, "-m", "emrld_jax.train", *others, *together]
    typed = {TYPED: shlex.join(["python", "-m", "emrld_jax.train", *arguments])}
    own_cores = os.sched_getaffinity(0)
    with ExitStack() as stack:
        children: list[subprocess.Popen] = []
        stack.callback(_end, children)
        stack.enter_context(_Forwarding(children))
        said = [stack.enter_context(tempfile.TemporaryFile()) for _ in shares[1:]]
        for i, cores in enumerate(shares):
            os.sched_setaffinity(0, cores)  # which the child inherits
            children.append(
                subprocess.Popen(
                    [*command, f"distributed.process_id={i}"],
                    env=HUGE_PAGES | os.environ | typed,
                    stdout=subprocess.DEVNULL if i else None,
                    stderr=said[i - 1] if i else None,
                    start_new_session=True,  # so that Ctrl-C reaches it through this process alone
                )
            )
        os.sched_setaffinity(0, own_cores)
        code = _wait(children)
        if code:
            _tell(children, said)
        return code


def _shares(processes: int) -> list[set[int]]:
    """The cores of each process."""
    if not hasattr(os, "sched_getaffinity"):
        raise ConfigError(f"processes={processes} needs Linux, which can bind processes to cores")
    cores = sorted(os.sched_getaffinity(0))
    if processes > len(cores):
        raise ConfigError(
            f"processes={processes} is not allowed: this machine has {len(cores)} core(s) for them"
        )
    each = len(cores) // processes  # as many for each: all wait for the slowest
    return [set(cores[i * each : (i + 1) * each]) for i in range(processes)]


def _free_address() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def _wait(children: Sequence[subprocess.Popen]) -> int:
    """Waits for all; helpers that stay when another process has failed are ended."""
    first, *helpers = children
    while any(child.poll() is None for child in children):
        if any(child.poll() for child in children):
            break
        time.sleep(0.05)
    first.wait()  # it may have much to save
    deadline = time.monotonic() + GRACE_S
    for child in helpers:
        try:
            child.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
    codes = [child.returncode for child in children]
    code = next((code for code in codes if code), 0)
    return code if code >= 0 else 128 - code


def _tell(children: Sequence[subprocess.Popen], said: Sequence[IO[bytes]]) -> None:
    """Shows the error messages of helpers, which have no console of their own."""
    for i, (child, file) in enumerate(zip(children[1:], said, strict=True), start=1):
        file.seek(0)
        lines = file.read().decode(errors="replace").splitlines()
        if errors := [line for line in lines if line.startswith("error:")]:
            print(f"process {i}: {errors[-1]}", file=sys.stderr)
        elif child.returncode == -signal.SIGKILL:
            print(
                f"process {i} was killed; if memory ran out, fewer runs need less", file=sys.stderr
            )


def _end(children: Sequence[subprocess.Popen]) -> None:
    for child in children:
        if child.poll() is None:
            child.kill()
            child.wait()


class _Forwarding:
    """Passes a first signal on to the first process, which stops them all; a second one to all."""

    SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def __init__(self, children: Sequence[subprocess.Popen]) -> None:
        self._children, self._received = children, 0

    def __enter__(self) -> None:
        for number in self.SIGNALS:
            signal.signal(number, self._pass_on)

    def __exit__(self, *_: object) -> None:
        for number in self.SIGNALS:
            signal.signal(number, signal.SIG_DFL)

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        self._received += 1
        for child in self._children[: 1 if self._received == 1 else None]:
            if child.poll() is None:
                child.send_signal(signal.SIGTERM if number == signal.SIGHUP else number)
