"""Any key of the terminal as a stop, while something moves."""

from __future__ import annotations

import contextlib
import os
import select
import threading
from collections.abc import Callable, Iterator

_LOOKS_EVERY_S = 0.05


@contextlib.contextmanager
def stop_on_key(stop: Callable[[str], None], terminal: int = 0) -> Iterator[bool]:
    """Call for a stop, once, at the first key that is pressed while the context is open.

    Args:
        stop: takes the reason; called from a thread of its own.
        terminal: file descriptor of it; standard input.

    Yields:
        Whether there is a terminal: where there is none, no key is waited for.
    """
    if not os.isatty(terminal):
        yield False
        return
    import termios
    import tty

    ended = threading.Event()
    before = termios.tcgetattr(terminal)
    listener = threading.Thread(target=_listen, args=(stop, terminal, ended), name="stop key", daemon=True)
    try:
        tty.setcbreak(terminal)  # keys come at once and unseen; Ctrl-C still interrupts
        listener.start()
        yield True
    finally:
        ended.set()
        listener.join()
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _listen(stop: Callable[[str], None], terminal: int, ended: threading.Event) -> None:
    while not ended.is_set():
        if select.select([terminal], [], [], _LOOKS_EVERY_S)[0]:
            with contextlib.suppress(OSError):  # a terminal that was closed is a reason, too
                os.read(terminal, 1)
            stop("a key was pressed")
            return
