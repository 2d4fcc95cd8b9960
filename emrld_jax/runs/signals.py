"""Ctrl-C and SIGTERM, answered between iterations."""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType
from typing import Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)
TOLD = "finishing this iteration, then saving; again: quit at once"


class StopSignals:
    """Notes the first signal instead of dying of it; a second one ends the process at once.

    Python runs handlers only once the compiled program that is going on returns. So a thread, woken
    by each signal at once, tells of the first one and ends the process at the second.
    """

    def __init__(self) -> None:
        self.received: signal.Signals | None = None

    def __enter__(self) -> Self:
        woken, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        self._wake_before = signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
        self._watcher = threading.Thread(target=_watch, args=(woken,), daemon=True)
        self._watcher.start()
        self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wake_before)
        os.close(self._wake)  # ends the thread
        self._watcher.join()

    @property
    def exit_code(self) -> int:
        """What a shell reports of a process that this signal ended; 0 if there was none."""
        return 0 if self.received is None else 128 + self.received

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = signal.Signals(number)
        for each in SIGNALS:
            signal.signal(each, signal.SIG_DFL)


def _watch(woken: int) -> None:
    """Reads the numbers of the signals that come, until the pipe's other end is closed."""
    seen = 0
    while number := os.read(woken, 1):
        if number[0] not in SIGNALS:
            continue
        seen += 1
        if seen > 1:
            os._exit(128 + number[0])
        # a progress bar leaves the cursor in its line
        print(f"{os.linesep * sys.stderr.isatty()}{TOLD}", file=sys.stderr, flush=True)
    os.close(woken)
