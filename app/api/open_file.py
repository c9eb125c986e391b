"""Files of the data directory as answers, which are whole even while the files are replaced or deleted."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from pathlib import Path

from starlette.responses import FileResponse
from starlette.types import Receive, Scope, Send

from app.api.problems import NotFound


class OpenFile(FileResponse):
    """A file that is opened now: headers and content are of the same version, also those of a range.

    Args:
        path: of the file.
        gone: the sentence of the problem if there is none.
        media_type: of its content.
        headers: further ones.
        filename: under which it is saved; None if it is only shown.
        disposition: whether a browser saves it or shows it, if it has a filename.

    Raises:
        NotFound: if there is no such file, or no plain one.
    """

    def __init__(
        self,
        path: Path,
        gone: str,
        *,
        media_type: str,
        headers: Mapping[str, str] | None = None,
        filename: str | None = None,
        disposition: str = "attachment",
    ) -> None:
        try:
            self._file = path.open("rb", buffering=0)
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
            raise NotFound(gone) from None
        status = os.fstat(self._file.fileno())
        if not stat.S_ISREG(status.st_mode):
            self._file.close()
            raise NotFound(gone)
        super().__init__(
            f"/dev/fd/{self._file.fileno()}",  # opened again, it is the same file, whatever has its name by then
            headers=headers,
            media_type=media_type,
            filename=filename,
            stat_result=status,
            content_disposition_type=disposition,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file and close it, also if whoever asked has gone."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()
