"""The paper's robot experiment (supplement, Fig. 1) with a simulated TurtleBot3, over the wire.

`python -m benchmarks.robot runs=reproduced/runs/main` exports a run of each algorithm on
`two_wheeled_drift`, starts the simulated robot as a process of its own, and has `bridges.run`
collect, adapt and execute under a drift of -0.65 rad a step, which it adds to the commands. One
picture shows what the adapted policies do. It can be stopped and goes on where it was.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.choice import origin
from benchmarks.loopback import stay_here
from benchmarks.records import write_record
from bridges import bundle
from bridges.command_line import configured, run_command
from bridges.messages import BridgeError
from bridges.picture import draw
from bridges.recording import read
from emrld_jax.fields import setting
from emrld_jax.study.plan import COMPARED
from emrld_jax.study.programs import Program

ENVIRONMENT = "two_wheeled_drift"
DRIFT = -0.65  # rad a control period


@dataclass
class RobotConfig:
    """All settings of the experiment."""

    runs: str = setting("reproduced/runs/main", "where emrld_jax.reproduce has put its runs")
    demos: str = setting("optimal", "of the shipped demonstrations")
    seed: int = setting(0, "of the runs", at_least=0)
    algos: list[str] = setting([*COMPARED], "algorithms", choices=COMPARED)
    out: str = setting("robot/experiment", "folder of bundles, recordings and the picture")
    robot: str = setting("dds", "how bridge and simulator speak", choices=("dds", "rclpy"))
    episodes: int = setting(5, "to collect, and to execute", at_least=1)
    speed: float = setting(4.0, "of the simulator's clock and the bridge's", above=0)
    domain_id: int = setting(78, "ROS domain that nobody else uses", at_least=0, at_most=101)


def export(config: RobotConfig, algo: str) -> Path:
    """The bundle of an algorithm's run."""
    out = Path(config.out) / f"{algo}.safetensors"
    if not out.is_file():
        chosen = Program(Path(config.runs), ENVIRONMENT, config.demos, algo, (config.seed,))
        folder = chosen.folder(config.seed).path
        if not folder.is_dir():
            raise BridgeError(f"{folder} is missing: train it by emrld_jax.reproduce figure=curves")
        _run("emrld_jax.export", f"run={folder}", f"out={out}")
    return out


@contextmanager
def simulator(config: RobotConfig) -> Iterator[None]:
    """The simulated robot, in a process of its own."""
    chosen = [f"robot={config.robot}", f"speed={config.speed:g}", "view=null"]
    command = [sys.executable, "-m", "bridges.sim_turtlebot", *chosen]
    with subprocess.Popen(
        [*command, f"link.domain_id={config.domain_id}"], stdout=subprocess.DEVNULL
    ) as process:
        try:
            yield
        finally:
            process.terminate()


def drive(config: RobotConfig, policy: Path) -> dict[str, Any]:
    """Collects, adapts and executes; a row of the table."""
    out = policy.with_suffix("")
    reached = [f"robot={config.robot}", f"link.domain_id={config.domain_id}", "reset=service"]
    task = [f"residual_angular_velocity={DRIFT}", f"episodes={config.episodes}"]
    chosen = [f"bundle={policy}", f"out={out}", *reached, *task, f"speed={config.speed:g}"]
    _run("bridges.run", *chosen, "--yes")
    told = json.loads((out / "summary.json").read_text())["recordings"]
    return {"algorithm": policy.stem, **told}


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    lines = [
        "| algorithm | return before | after | success before | after | time to goal "
        "| odometry's age when acting, median and p99 |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        before, after = row.get("recording_0"), row["execution"]
        seconds, age = after["time_to_goal_s"], after["odometry_age_s"]
        cells = [
            row["algorithm"],
            *(f"{part['return']:.1f}" if part else "--" for part in (before, after)),
            *(f"{part['success']:.0%}" if part else "--" for part in (before, after)),
            "--" if seconds is None else f"{seconds:.1f} s",
            f"{1e3 * age['median']:.0f} ms, {1e3 * age['p99']:.0f} ms",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> int:
    """Runs the experiment as the command line says."""
    config = configured(
        "benchmarks.robot",
        "Collect, adapt and execute with every algorithm on a simulated TurtleBot3 that drifts.",
        ["runs=reproduced/runs/main", "algos=[emrld,maml] robot=rclpy"],
        RobotConfig(),
    )
    if config is None:
        return 0
    stay_here()
    policies = [export(config, algo) for algo in config.algos]
    with simulator(config):
        rows = [drive(config, policy) for policy in policies]
    executed = {path.stem: read(path.with_suffix("") / "execution") for path in policies}
    picture = Path(config.out) / "adapted"
    drawn = draw(bundle.read(policies[0]), executed, picture)
    write_record(f"robot-{config.robot}", {**origin("robot"), "rows": rows}, table(rows))
    print(f"{picture}.png and .svg" if drawn else "no picture: matplotlib is missing")
    return 0


def _run(module: str, *arguments: str) -> None:
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, check=False)
    if done.returncode:
        raise BridgeError(f"{' '.join(command)} ended with {done.returncode}; see above")


if __name__ == "__main__":
    run_command(main)
