"""A first meeting of processes, before JAX's own: whoever is missing or different is told by name.

JAX's runtime ends the process with a stack trace if it cannot reach the coordinator in time.
"""

from __future__ import annotations

import json
import socket
import time
from contextlib import suppress
from typing import Any

from emrld_jax.runs.config import ConfigError, DistributedSettings, coordinator_address

RETRY_S = 0.2
LIMIT = 65536  # bytes of a greeting


def meet(settings: DistributedSettings, agreed: str) -> None:
    """Returns in each process once all have come, with the same thing agreed upon.

    Args:
        settings: who meets where, and how long to wait.
        agreed: a text that must be the same in all processes.

    Raises:
        ConfigError: names the processes that did not come in time, or what is different.
    """
    host, port = coordinator_address(settings)
    deadline = time.monotonic() + settings.timeout
    try:
        if settings.process_id == 0:
            _receive_all(port, settings, agreed, deadline)
        else:
            _introduce((host, port), settings, agreed, deadline)
    except OSError as error:
        raise ConfigError(
            f"distributed.coordinator={settings.coordinator}: process {settings.process_id} "
            f"reached no process 0 there within distributed.timeout={settings.timeout} s ({error})"
            if settings.process_id
            else f"distributed.coordinator={settings.coordinator}: this process, which has id 0, "
            f"cannot listen there ({error}); choose a free port of this machine"
        ) from error


def _receive_all(port: int, settings: DistributedSettings, agreed: str, deadline: float) -> None:
    """The first process waits for all others, then sends each of them on."""
    others: dict[int, socket.socket] = {}
    expected = set(range(1, settings.num_processes))
    try:
        with socket.create_server(("", port), backlog=settings.num_processes) as server:
            while missing := expected - others.keys():
                server.settimeout(max(deadline - time.monotonic(), 0.001))
                try:
                    connection, _ = server.accept()
                except TimeoutError:
                    names = ", ".join(map(str, sorted(missing)))
                    raise ConfigError(
                        f"distributed.timeout={settings.timeout} s went by without process {names} "
                        f"of {settings.num_processes}; all must be started within that time, with "
                        f"distributed.coordinator={settings.coordinator}"
                    ) from None
                greeting = _greeting(connection)
                problem = _problem(greeting, settings, agreed, missing)
                if problem:
                    connection.sendall(json.dumps({"problem": problem}).encode() + b"\n")
                    connection.close()
                    if greeting is not None:
                        raise ConfigError(problem)
                else:
                    others[greeting["process_id"]] = connection  # type: ignore[index]
        for connection in others.values():
            connection.sendall(b"{}\n")
            connection.settimeout(RETRY_S)
            with suppress(TimeoutError):  # it closes first, so that the port is free at once
                connection.recv(1)
    finally:
        for connection in others.values():
            connection.close()


def _problem(
    greeting: Any, settings: DistributedSettings, agreed: str, missing: set[int]
) -> str | None:
    """What is wrong with a process that introduces itself."""
    if greeting is None:
        return "this is not a process of emrld_jax.train"
    process_id = greeting["process_id"]
    if greeting["agreed"] != agreed:
        return (
            f"process {process_id} was started with other settings, or another version of the "
            "code or its packages, than process 0"
        )
    if process_id not in missing:
        return (
            f"distributed.process_id={process_id} is given to two processes, or is not below "
            f"distributed.num_processes={settings.num_processes}"
        )
    return None


def _introduce(
    where: tuple[str, int], settings: DistributedSettings, agreed: str, deadline: float
) -> None:
    """Another process greets the first one, as often as it takes, and waits for all."""
    greeting = json.dumps({"process_id": settings.process_id, "agreed": agreed}).encode() + b"\n"
    while True:
        left = deadline - time.monotonic()
        try:
            connection = socket.create_connection(where, timeout=max(left, 0.001))
            break
        except OSError:
            if left < RETRY_S:
                raise
            time.sleep(RETRY_S)
    with connection:
        connection.sendall(greeting)
        # the first process may have begun to wait later
        connection.settimeout(max(deadline - time.monotonic(), 0.0) + settings.timeout)
        answer = _line(connection)
    if answer is None:
        raise ConfigError(
            f"distributed.coordinator={settings.coordinator}: process 0 ended, or did not answer "
            f"within distributed.timeout={settings.timeout} s, before all "
            f"{settings.num_processes} processes had come; its message tells why"
        )
    if "problem" in answer:
        raise ConfigError(str(answer["problem"]))


def _greeting(connection: socket.socket) -> dict[str, Any] | None:
    connection.settimeout(5)
    said = _line(connection)
    whole = said is not None and isinstance(said.get("process_id"), int) and "agreed" in said
    return said if whole else None


def _line(connection: socket.socket) -> dict[str, Any] | None:
    """A line of JSON that the other side sends; None if it is no such thing."""
    try:
        with connection.makefile("rb") as file:
            value = json.loads(file.readline(LIMIT))
    except (OSError, ValueError):
        return None
    return value if isinstance(value, dict) else None
