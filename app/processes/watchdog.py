"""Ends child processes that show no sign of life.

Every child tells twice a second that it lives (`process_server.Alive`), from a thread of its own. A child that is
silent and stopped (SIGSTOP) is frozen; one that is silent for long is, too; one that lives but answers nobody hangs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

LOOK_S = 0.25  # between two looks
STOPPED_S = 1.0  # a process that the system has stopped may be silent
SILENT_S = 30.0  # any other: compiling and loading on a busy machine keep even a thread of its own from speaking
_STOPPED = "T"


class Watchdog:
    """Watches one process, in a thread of its own.

    Time is counted in looks, not by the clock: what passes while the service itself is stopped (Ctrl-Z) is no silence.

    Args:
        pid: of the process.
        answer_s: how long it may answer nobody while requests wait [s].
        is_asked: whether requests wait.
        bark: called once, with whether the process is frozen rather than hanging; ends it.
    """

    def __init__(
        self, pid: int, answer_s: Callable[[], float], is_asked: Callable[[], bool], bark: Callable[[bool], None]
    ) -> None:
        self._pid, self._answer_s, self._is_asked, self._bark = pid, answer_s, is_asked, bark
        self._is_over = threading.Event()
        self._has_spoken = self._has_answered = True
        self._silent_s = self._waited_s = 0.0
        threading.Thread(target=self._watch, name=f"watchdog-{pid}", daemon=True).start()

    def spoken(self) -> None:
        """The process has sent something."""
        self._has_spoken = True

    def answered(self) -> None:
        """The process has answered somebody."""
        self._has_answered = True

    def stop(self) -> None:
        """Watch no more."""
        self._is_over.set()

    def _watch(self) -> None:
        while not self._is_over.wait(LOOK_S):
            self._silent_s = 0.0 if self._has_spoken else self._silent_s + LOOK_S
            # Waiting behind others is no sign of hanging, so an answer to anybody counts.
            self._waited_s = self._waited_s + LOOK_S if self._is_asked() and not self._has_answered else 0.0
            self._has_spoken = self._has_answered = False
            is_frozen = self._silent_s >= SILENT_S or (self._silent_s >= STOPPED_S and _is_stopped(self._pid))
            if is_frozen or self._waited_s > self._answer_s():
                self._bark(is_frozen)
                return


def _is_stopped(pid: int) -> bool:
    """Whether the system has stopped a process; False where it does not tell."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="latin-1")
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] == _STOPPED
