"""Where a run comes from: code, versions, command, machine, demonstrations."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from emrld_jax.runs.config import ConfigError

DEMOS = ("demos", "outer_demos")  # what may be recorded of demonstrations
CODE = (".", "../envs_jax")  # what decides results, seen from this package
TYPED = "EMRLD_JAX_COMMAND"  # tells a process that a command starts what the user has typed
PACKAGES = ("emrld-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")
PHYSICS = ("mujoco", "mujoco-mjx", "gymnasium")  # of extras, which need not be there


def provenance(demos: Path, outer_demos: Path | None = None) -> dict[str, Any]:
    """A record of this process and of the demonstrations, as JSON values."""
    files = {name: path for name, path in zip(DEMOS, (demos, outer_demos), strict=True) if path}
    return {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": typed_command(),
        **software(),
        "machine": machine(),
        **{name: {"path": str(path), "sha256": sha256(path)} for name, path in files.items()},
    }


def read_provenance(path: Path) -> dict[str, Any]:
    """The record of how a run began, with all that is compared later.

    Raises:
        ConfigError: the file cannot be read, lacks something, or has a list or a text where a table
            must be.
    """
    try:
        record = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from error
    kinds = {"code": dict, "packages": dict, "demos": dict, "resumed": list}
    whole = isinstance(record, dict) and all(
        isinstance(record.get(name), kind) for name, kind in kinds.items()
    )
    shown = [record[name] for name in DEMOS if name in record] if whole else []
    if not whole or not all(isinstance(own, dict) and "sha256" in own for own in shown):
        raise ConfigError(f"{path} must have {', '.join(kinds)}, and demos a sha256")
    if not isinstance(record.get("machine", {}), dict):  # shown, so it need not be there
        raise ConfigError(
            f"{path}: machine={record['machine']!r} is not a table of names and values"
        )
    return record


def other_demonstrations(record: Path, demos: Path) -> str:
    """A note if a run's record does not say that it was trained on this file; empty if it does."""
    try:
        trained_on = read_provenance(record)["demos"]["sha256"]
    except ConfigError as error:  # only training needs the record
        return f"note: {error}"
    same = sha256(demos) == trained_on
    return "" if same else f"note: {demos} is not the file that the run was trained on"


def software() -> dict[str, Any]:
    """The code's commit and the versions of what it stands on."""
    return {
        "code": code_version(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in (*PACKAGES, *PHYSICS)},
    }


def machine() -> dict[str, Any]:
    """What the process runs on."""
    return {
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "processes": jax.process_count(),
        "malloc": os.environ.get("GLIBC_TUNABLES", ""),  # large pages make large arrays faster
    }


def code_version() -> dict[str, Any]:
    """The commit this package's code is of, and whether files differ from it."""
    package = Path(__file__).parents[1]
    # an installed copy may lie in somebody else's repository: only tracked code has a commit
    tracked = _git(package, "ls-files", "--error-unmatch", "__init__.py")
    commit = _git(package, "rev-parse", "HEAD") if tracked else None
    if commit is None:
        return {"commit": "unknown", "dirty": None}
    return {"commit": commit, "dirty": bool(_git(package, "status", "--porcelain", "--", *CODE))}


def typed_command() -> str:
    """The command line that led to this process, as a shell takes it."""
    if typed := os.environ.get(TYPED):
        return typed
    module = sys.modules["__main__"].__spec__
    start = ["python", "-m", module.name] if module else [sys.argv[0]]
    return shlex.join([*start, *sys.argv[1:]])


def sha256(path: Path) -> str:
    """Hash of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            check=False,
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed" if package in PHYSICS else "unknown"


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or "unknown")
