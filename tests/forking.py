"""Commands in processes of their own that need not import JAX and the rest again.

A server imports what commands import, and forks for each: the child then is what
`python -m MODULE ARGUMENTS` is once its imports are done. Nothing has been computed before.
"""

from __future__ import annotations

import gc
import json
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

LIMIT_S = 240  # then a command is ended, by SIGALRM


class Server:
    """Runs commands one after the other."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.forking"],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, module: str, arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
        """Runs a module to its end, in the present working directory."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with tempfile.TemporaryDirectory() as folder:
            out, err = Path(folder) / "out", Path(folder) / "err"
            request = [module, *arguments], os.getcwd(), str(out), str(err)
            self._process.stdin.write(f"{json.dumps(request)}\n")
            self._process.stdin.flush()
            code = int(self._process.stdout.readline())
            return subprocess.CompletedProcess(request[0], code, out.read_text(), err.read_text())

    def close(self) -> None:
        """Ends it."""
        self._process.communicate()


def _serve() -> list[str]:
    """Forks for each request, and tells how it ended; only a child returns, with its command."""
    while line := sys.stdin.readline():
        command, place, out, err = json.loads(line)
        with warnings.catch_warnings():
            # OpenBLAS has threads, and provides for a fork
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if not child:
            os.chdir(place)
            for number, path in ((0, os.devnull), (1, out), (2, err)):
                flags = os.O_RDWR | os.O_CREAT if number else os.O_RDONLY
                os.dup2(os.open(path, flags, 0o600), number)
            signal.alarm(LIMIT_S)
            return command
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
    sys.exit()


if __name__ == "__main__":
    import emrld_jax.analysis.page
    import emrld_jax.runs.evaluate_run
    import emrld_jax.runs.training  # noqa: F401

    gc.freeze()  # so that a child's collections copy no memory
    module, *sys.argv[1:] = _serve()
    runpy.run_module(module, run_name="__main__", alter_sys=True)
