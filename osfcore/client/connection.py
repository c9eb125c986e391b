"""HTTP with the service: requests, streams of events, and problems (RFC 9457) as errors of one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2

from osfcore.errors import OsfError
from osfcore.io.files import file_at_once

_QUIET_S = 60.0  # without a byte before a stream counts as lost; a service that works sends something sooner
_RECONNECTS = 5  # in a row, without an event between them


class ServiceError(OsfError):
    """What the service answered instead, or that it does not answer.

    Args:
        sentence: for a person.
        status: of HTTP; 0 where nothing was answered.
    """

    def __init__(self, sentence: str, status: int = 0) -> None:
        super().__init__(sentence)
        self.status = status


class Connection:
    """One service.

    Args:
        http: a client of its own, with base address and headers; closed with this.
    """

    def __init__(self, http: httpx2.Client) -> None:
        self._http = http

    @staticmethod
    def to(url: str, token: str | None, timeout_s: float) -> Connection:
        """Connect to an address.

        Args:
            url: such as http://127.0.0.1:8000.
            token: of a service that was started with one.
            timeout_s: how long an answer may take [s].
        """
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        return Connection(httpx2.Client(base_url=url, headers=headers, timeout=timeout_s))

    def close(self) -> None:
        """Release the sockets."""
        self._http.close()

    def json(self, method: str, path: str, body: object = None, **query: object) -> Any:  # noqa: ANN401
        """What a request answers, parsed.

        Raises:
            ServiceError: if it is refused or there is no answer.
        """
        return self._answer(method, path, query, json=body).json()

    def send(self, method: str, path: str, content: bytes, kind: str, **query: object) -> Any:  # noqa: ANN401
        """What a request with a file answers, parsed.

        Args:
            method: of HTTP.
            path: from the root.
            content: of the file.
            kind: its media type.
            query: parameters; those that are None are left out.

        Raises:
            ServiceError: if it is refused or there is no answer.
        """
        return self._answer(method, path, query, content=content, headers={"Content-Type": kind}).json()

    def bytes(self, path: str, **query: object) -> bytes:
        """A file.

        Raises:
            ServiceError: if there is none or no answer.
        """
        return self._answer("GET", path, query).content

    def download(self, path: str, to: Path) -> Path:
        """Write a file to disk piece by piece; it is there when it is whole.

        Raises:
            ServiceError: if there is none or no answer.
            CannotWrite: if the disk refuses.
        """
        with self._told(), self._http.stream("GET", path) as answer:
            if answer.is_error:
                answer.read()
            _check(answer)
            with file_at_once(to) as partial, partial.open("wb") as file:
                for chunk in answer.iter_bytes():
                    file.write(chunk)
        return to

    def follow(self, path: str) -> Iterator[Any]:
        """The data of events of a stream, parsed, until it ends; it is opened again where the network breaks it.

        Raises:
            ServiceError: if there is no such stream, or the service no longer answers.
        """
        breaks = 0
        while True:
            try:
                with self._http.sse(path, timeout=_QUIET_S) as events:
                    if events.response.is_error:
                        events.response.read()
                    _check(events.response)
                    for event in events:
                        breaks = 0
                        yield event.json()
                    return
            except httpx2.TransportError as error:
                breaks += 1
                if breaks > _RECONNECTS or isinstance(error, httpx2.ConnectError):
                    raise self._silent(error) from error

    def _answer(self, method: str, path: str, query: dict[str, object], **more: Any) -> httpx2.Response:  # noqa: ANN401
        params: Any = {key: value for key, value in query.items() if value is not None}
        with self._told():
            answer = self._http.request(method, path, params=params, **more)
        _check(answer)
        return answer

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except (httpx2.TransportError, httpx2.InvalidURL) as error:
            raise self._silent(error) from error

    def _silent(self, error: Exception) -> ServiceError:
        told = f"The service at {self._http.base_url} does not answer ({error})"
        return ServiceError(f"{told}; start it with 'osf serve', or give its address.")


def _check(answer: httpx2.Response) -> None:
    if answer.is_success:
        return
    try:
        detail = answer.json()["detail"]
    except (ValueError, KeyError, TypeError):
        told = f"{answer.url} answered {answer.status_code} as this service does not"
        detail = f"{told}; give the address of one that 'osf serve' runs."
    raise ServiceError(detail, answer.status_code)
