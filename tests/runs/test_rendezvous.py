"""How processes meet: all of them with the same settings, or a message that says who is missing."""

from __future__ import annotations

import socket
from concurrent.futures import ThreadPoolExecutor

import pytest

from emrld_jax.runs.config import ConfigError, DistributedSettings
from emrld_jax.runs.rendezvous import meet


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def outcomes(ids: list[int], num_processes: int, agreed: list[str], timeout: int = 5) -> list[str]:
    """What each process is told, all at once; empty if it met the others."""
    coordinator = f"127.0.0.1:{free_port()}"

    def one(process_id: int, text: str) -> str:
        try:
            meet(DistributedSettings(coordinator, num_processes, process_id, timeout), text)
        except ConfigError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor(len(ids)) as pool:
        return list(pool.map(one, ids, agreed))


def test_processes_meet_and_leave_the_port_free() -> None:
    assert outcomes([2, 0, 1], 3, ["same"] * 3) == ["", "", ""]


def test_a_missing_process_is_named() -> None:
    first, other = outcomes([0, 2], 3, ["same"] * 2, timeout=1)
    assert "without process 1 of 3" in first
    assert "distributed.timeout=1" in first
    assert "process 0 ended, or did not answer" in other
    assert "before all 3 processes had come" in other


def test_other_settings_are_told_to_both() -> None:
    told = outcomes([0, 1], 2, ["seed=0", "seed=1"])
    assert told[0] == told[1]
    assert "process 1 was started with other settings" in told[0]


def test_an_id_given_twice_is_told() -> None:
    told = outcomes([0, 1, 1], 3, ["same"] * 3)
    assert "distributed.process_id=1 is given to two processes" in told[0]


def test_a_coordinator_that_nobody_listens_at() -> None:
    (told,) = outcomes([1], 2, ["same"], timeout=1)
    assert "process 1 reached no process 0" in told


def test_strangers_do_not_disturb() -> None:
    port = free_port()
    settings = [DistributedSettings(f"127.0.0.1:{port}", 2, i, 5) for i in range(2)]
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(meet, settings[0], "same")
        while True:
            try:
                with socket.create_connection(("127.0.0.1", port), timeout=1) as stranger:
                    stranger.sendall(b"GET / HTTP/1.1\n")
                    assert b"not a process" in stranger.recv(1000)
                break
            except ConnectionRefusedError:
                continue
        pool.submit(meet, settings[1], "same").result()
        first.result()


@pytest.mark.parametrize("coordinator", ["here", "here:", ":1234", "here:0", "here:99999", "a:b"])
def test_what_is_no_address_is_refused(coordinator: str) -> None:
    with pytest.raises(ConfigError, match="must be HOST:PORT"):
        meet(DistributedSettings(coordinator, 2, 0, 1), "")
