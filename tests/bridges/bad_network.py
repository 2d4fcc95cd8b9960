"""Two processes in network namespaces of their own, and between them packets get lost and late.

The namespaces have a TUN device each, whose packets this process carries from one to the other: it
needs no netem in the kernel, but the right to make namespaces (root, as a rule). It is a program
of its own, as it forks: `python bad_network.py JSON`, with the arguments of `run`.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import json
import os
import random
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

ADDRESSES = ("10.77.0.1", "10.77.0.2")
DEVICE = "bad0"
_CLONE_NEWNET = 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_LIBC = ctypes.CDLL(None, use_errno=True)


def run(
    commands: Sequence[Sequence[str]],
    outputs: Sequence[str],
    loss: float,
    delay: float,
    seconds: float,
    rest: float,
) -> dict[str, Any]:
    """Runs two commands until the second one ends, and the first one a little longer.

    Args:
        commands: two of them.
        outputs: files for what each says.
        loss: share of the packets that get lost.
        delay: s that each packet takes.
        seconds: that it may take at most.
        rest: s that the first command has then.
    """
    with BadNetwork(commands, list(map(Path, outputs)), loss, delay) as network:
        first, second = network.processes
        code = network.carry(second, seconds)
        network.carry(first, rest)
    return {"code": code, "lost": network.lost, "carried": network.carried}


def dds_configuration(other: str) -> str:
    """CycloneDDS's, for a process whose only other one is at this address."""
    return (
        "<CycloneDDS><Domain><General><Interfaces>"
        f'<NetworkInterface name="{DEVICE}" multicast="false"/></Interfaces>'
        "<AllowMulticast>false</AllowMulticast></General><Discovery>"
        f'<ParticipantIndex>auto</ParticipantIndex><Peers><Peer Address="{other}"/></Peers>'
        "<MaxAutoParticipantIndex>4</MaxAutoParticipantIndex></Discovery></Domain></CycloneDDS>"
    )


class BadNetwork:
    """Carries packets between two commands.

    Args:
        commands: two of them.
        outputs: files for what each says.
        loss: share of the packets that get lost.
        delay: s that each packet takes.
    """

    def __init__(
        self,
        commands: Sequence[Sequence[str]],
        outputs: Sequence[Path],
        loss: float,
        delay: float,
    ) -> None:
        self._loss, self._delay = loss, delay
        self._random = random.Random(0)
        self.lost = self.carried = 0
        self.processes: list[subprocess.Popen[bytes]] = []
        self._devices: list[int] = []
        for k, (command, output) in enumerate(zip(commands, outputs, strict=True)):
            self._start(command, output, ADDRESSES[k], ADDRESSES[1 - k])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        for process in self.processes:
            process.kill()
            process.wait(10)
        for device in self._devices:
            os.close(device)

    def carry(self, process: subprocess.Popen[bytes], seconds: float) -> int | None:
        """Carries packets until a process ends; its exit code, None if it takes longer."""
        late = time.monotonic() + seconds
        waiting: list[tuple[float, int, int, bytes]] = []  # when due, order, to which, packet
        number = 0
        while process.poll() is None and time.monotonic() < late:
            due = waiting[0][0] - time.monotonic() if waiting else 0.05
            ready, _, _ = select.select(self._devices, (), (), min(max(due, 0.0), 0.05))
            for device in ready:
                packet, number = os.read(device, 65536), number + 1
                if self._random.random() < self._loss:
                    self.lost += 1
                    continue
                other = 1 - self._devices.index(device)
                heapq.heappush(waiting, (time.monotonic() + self._delay, number, other, packet))
            while waiting and waiting[0][0] <= time.monotonic():
                _, _, other, packet = heapq.heappop(waiting)
                os.write(self._devices[other], packet)
                self.carried += 1
        return process.poll()

    def _start(self, command: Sequence[str], output: Path, own: str, other: str) -> None:
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)

        def in_the_child() -> None:
            socket.send_fds(there, [b"x"], [_join(own)])

        with output.open("wb") as file, here, there:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env={**os.environ, "CYCLONEDDS_URI": dds_configuration(other)},
                preexec_fn=in_the_child,  # noqa: PLW1509
            )
            self.processes.append(process)
            here.settimeout(10)
            _, descriptors, _, _ = socket.recv_fds(here, 1, 1)
        self._devices += descriptors


def _join(address: str) -> int:
    """Moves this process into a namespace of its own; its device, whose packets are ours."""
    if _LIBC.unshare(_CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), "unshare")
    device = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", DEVICE.encode(), _IFF_TUN | _IFF_NO_PI))
    for arguments in (
        ("link", "set", "lo", "up"),
        ("addr", "add", f"{address}/24", "dev", DEVICE),
        ("link", "set", DEVICE, "up"),
    ):
        subprocess.run(["ip", *arguments], check=True, capture_output=True)
    return device


if __name__ == "__main__":
    try:
        print(json.dumps(run(**json.loads(sys.argv[1]))))
    except (OSError, subprocess.CalledProcessError) as error:
        sys.exit(f"impossible here: {error}")
