"""Where `osf serve` logs: standard error, and files in the data directory that replace each other."""

from __future__ import annotations

import logging
import sys
import time
from contextlib import suppress
from logging.handlers import RotatingFileHandler
from pathlib import Path

FILE_BYTES, FILES = 2_000_000, 5  # the newest is service.log, the older ones end in .1 to .4


class ServiceLogFile(RotatingFileHandler):
    """A log file that may fail, on a disk that is full or read-only: it says so once, and tries again every time.

    Args:
        path: of the newest file; its folder is made.
    """

    def __init__(self, path: Path) -> None:
        with suppress(OSError):  # then opening the file fails, too
            path.parent.mkdir(parents=True, exist_ok=True)
        super().__init__(path, maxBytes=FILE_BYTES, backupCount=FILES - 1, encoding="utf-8", delay=True)
        self._path = path
        self._has_failed = False

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  the base class calls it
        """Let go of a file that failed; no traceback for each record."""
        error = sys.exc_info()[1]
        if self.stream:
            with suppress(OSError):
                self.stream.close()
        self.stream = None  # pyright: ignore[reportAttributeAccessIssue]  the next record opens it again
        if isinstance(error, OSError) and not self._has_failed:
            self._has_failed = True
            with suppress(OSError):  # standard error may be on the same disk
                print(f"{self._path} cannot be written ({error.strerror}); logging here alone.", file=sys.stderr)


def start_log(data_dir: Path) -> None:
    """Let everything from warnings on be logged in this process, with times in UTC."""
    formatter = logging.Formatter("%(asctime)sZ %(levelname)s %(name)s: %(message)s", "%Y-%m-%dT%H:%M:%S")
    formatter.converter = time.gmtime
    handlers = (logging.StreamHandler(sys.stderr), ServiceLogFile(data_dir / "logs" / "service.log"))
    for handler in handlers:
        handler.setFormatter(formatter)
    logging.basicConfig(level=logging.WARNING, handlers=handlers)
