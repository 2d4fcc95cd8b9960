"""A bad network between the bridge and a simulated robot: packets get lost, and come late."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bridges import bundle
from bridges.recording import read
from tests.bridges import robot_bundles
from tests.bridges.conftest import ROOT
from tests.bridges.wire import assert_never_unsafe, seen_in

pytest.importorskip("cyclonedds")


def test_a_bad_network_is_never_unsafe(domain: int, tmp_path: Path) -> None:
    """30 % of all packets get lost, each takes 200 ms: in the network between two processes."""
    bundle.write(tmp_path / "policy.safetensors", robot_bundles.in_arena(0.6))
    python, link = (sys.executable, "-u", "-m"), f"link.domain_id={domain}"
    robot = ("robot=dds", "view=null", "status_every=0.05", "command_timeout=null", link)
    bridge = ("robot=dds", "mode=collect", "episodes=1", "reset=service", "--yes", link)
    files = (f"bundle={tmp_path}/policy.safetensors", f"out={tmp_path}/out")
    outputs = [str(tmp_path / name) for name in ("robot.txt", "bridge.txt")]
    settings = {
        "commands": [
            (*python, "bridges.sim_turtlebot", *robot),
            (*python, "bridges.run", *bridge, *files, "link.connect_timeout=30"),
        ],
        "outputs": outputs,
        **{"loss": 0.3, "delay": 0.2, "seconds": 60, "rest": 1.5},
    }
    program = str(ROOT / "tests" / "bridges" / "bad_network.py")
    done = subprocess.run(
        [sys.executable, program, json.dumps(settings)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    if "impossible here" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr

    told, said = json.loads(done.stdout), Path(outputs[1]).read_text()
    assert told["code"] in (0, 2), said
    assert 0.2 < told["lost"] / (told["lost"] + told["carried"]) < 0.4
    seen = seen_in(Path(outputs[0]).read_text().splitlines())
    assert_never_unsafe(seen, list(read(tmp_path / "out" / "recording_0").episodes))
