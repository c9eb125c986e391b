"""`osf serve`: the service and its page on one port, and its log; `osf backup` and `osf restore`: what it keeps."""

from __future__ import annotations

import errno
import ipaddress
import logging
import os
import secrets
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import psutil
import tyro

from osfcore.errors import InvalidInput, OsfError
from osfcore.extras import need

from .command import DataCommand

if TYPE_CHECKING:
    from types import FrameType

    import uvicorn

    from ..services.service_settings import Settings

_BACKLOG = 128
_MAX_FRAME_BYTES = 1 << 16  # from a browser to the 3D view
_GRACE_S = 2  # for open requests after Ctrl-C
_ADDRESSES_GB = 3.0  # of a process: its threads alone reserve 1.9 on two cores
_MEMORY_GB = 1.0  # of all processes, which share 0.65 at rest and 0.9 while an episode of one object runs (sums of Pss)
_MEMORY_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
FILE_BYTES, FILES = 2_000_000, 5  # of the log: the newest is service.log, the older ones end in .1 to .4


class CannotListen(OsfError):
    """The address cannot be served."""


class LittleMemory(OsfError):
    """The service would not run in the memory that there is."""

    def __init__(self, has: str, needed_gb: float) -> None:
        super().__init__(f"There is too little memory for the service: {has}, and it needs {needed_gb:g} GB.")


@dataclass(frozen=True)
class Serve(DataCommand):
    """Start the service and print the address of its page. Ctrl-C stops it."""

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines in."""
    port: int = 8000
    """Port of page, REST and viewer alike; 0 takes a free one."""
    robot: str | None = None
    """Address of a robot that the page may drive, as for 'osf robot'; its motion is allowed on the page, each time."""
    box: tuple[float, float, float, float] | None = None
    """x0 y0 x1 y1 [m] that the robot's pusher stays in, besides its own; 0.35 m to each side without it."""
    top_speed: float | None = None
    """Of the robot's pusher [m/s]; 0.1 without it."""

    simulator: Literal["pybullet", "mujoco"] | None = None
    """What moves the objects; PyBullet where it is installed, else MuJoCo."""

    def run(self) -> dict[str, Any]:
        """Serve until interrupted."""
        return self.serve()

    def serve(self, on_ready: Callable[[str], object] = lambda _: None) -> dict[str, Any]:
        """Serve until interrupted; call `on_ready` with the address of the page once the service answers."""
        check_memory()
        need("serve", "This command")
        from ..storage.database import check_data_dir

        listener = bound_socket(self.host, self.port)
        with closing(listener):
            check_data_dir(self.data_dir)  # refused now, in one sentence, if it cannot be used
            url = _url(self.host, listener.getsockname()[1])
            settings, login = _settings(self)
            start_log(self.data_dir)
            server = _server(settings, url + login, on_ready)
            # The server has a handler of its own, and raises the signal again once everything has stopped.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            # A terminal that closes asks for the same as `kill`.
            if sys.platform != "win32":
                signal.signal(signal.SIGHUP, lambda *_: signal.raise_signal(signal.SIGTERM))
            server.run(sockets=[listener])
        return {"url": url}


def check_memory() -> None:
    """Refuse to begin what would end in the middle of a start, or answer nobody.

    Raises:
        LittleMemory: if each process, or all of them together, may have less memory than they need.
    """
    if sys.platform == "linux":
        limit, _ = psutil.Process().rlimit(psutil.RLIMIT_AS)
        if limit != psutil.RLIM_INFINITY and limit < _ADDRESSES_GB * 1e9:
            raise LittleMemory(f"ulimit -v lets each process have {limit / 1e9:.1f} GB", _ADDRESSES_GB)
    for path in _MEMORY_LIMITS:
        with suppress(OSError, ValueError):  # no such file, or "max"
            if (limit := int(path.read_text())) < _MEMORY_GB * 1e9:
                raise LittleMemory(f"this container may have {limit / 1e9:.1f} GB", _MEMORY_GB)


def bound_socket(host: str, port: int) -> socket.socket:
    """A socket that has the port, so that nobody takes it while the service starts.

    Raises:
        InvalidInput: if there is no such port.
        CannotListen: if it cannot be had.
    """
    if not 0 <= port <= 65535:
        raise InvalidInput("port", port, "between 0 and 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError:
        raise CannotListen(f"The host {host!r} is not an address of this machine.") from None
    listener = socket.socket(family, kind, protocol)
    if sys.platform != "win32":  # where it would take the port from whoever has it
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(address)
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            text = f"Port {port} on {host} is in use; stop the program that has it or choose another with --port."
        elif error.errno == errno.EACCES:
            text = f"Port {port} may not be used by this user; choose one above 1023 with --port."
        else:
            text = f"Port {port} on {host} cannot be used ({error.strerror})."
        raise CannotListen(text) from None
    return listener


def _settings(serve: Serve) -> tuple[Settings, str]:
    """Settings from options and environment, and what an address needs to let one in.

    Whoever lets other machines in has a token, if need be a new one, which is shown with the address.
    """
    from pydantic import SecretStr, ValidationError

    from osfcore.world.simulators import check_simulator

    from ..services.robot import host_of, limits_of
    from ..services.service_settings import Settings

    robot: dict[str, Any] = {"robot": serve.robot, "robot_box": serve.box, "robot_top_speed_m_s": serve.top_speed}
    chosen = {**robot, "simulator": serve.simulator}
    given = {name: value for name, value in chosen.items() if value is not None}  # the environment has the rest
    try:
        settings = Settings(host=serve.host, port=serve.port, data_dir=serve.data_dir, **given)
    except ValidationError as error:
        first = error.errors()[0]
        name = "OSF_" + "_".join(str(part) for part in first["loc"]).upper()
        raise InvalidInput(name, repr(first["input"])[:60], f"valid ({first['msg']})") from None
    check_simulator(settings.simulator)
    limits_of(settings)
    if settings.robot is not None:
        host_of(settings.robot)
    if settings.token is None and not is_loopback(serve.host):
        token = secrets.token_urlsafe(24)
        return settings.model_copy(update={"token": SecretStr(token)}), f"/?token={token}"
    return settings, ""


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _server(settings: Settings, url: str, on_ready: Callable[[str], object]) -> uvicorn.Server:
    """A server that tells its address once it is ready, and ends what keeps requests before it waits for them."""
    import uvicorn

    from ..api.app_factory import create_app
    from ..api.guards.connection_timeouts import PromptProtocol
    from ..processes.child_process import end_children

    app = create_app(settings)

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            if not self.started:
                return
            if not app.state.services.objects.names():
                missing = "There are no objects on this machine yet; fetch them on the page or with 'osf assets fetch'."
                print(missing, file=sys.stderr, flush=True)
            print(url, flush=True)
            on_ready(url)

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            if self.should_exit:  # who asks twice does not want to wait for anything
                end_children()
                os._exit(128 + sig)
            services = getattr(app.state, "services", None)
            if services is not None:
                services.begin_closing()
            super().handle_exit(sig, frame)

    return Server(
        uvicorn.Config(
            app,
            workers=1,  # the state is in the process
            lifespan="on",
            log_config=None,  # its errors go where all others go
            log_level="warning",
            access_log=False,
            http=PromptProtocol,
            ws_max_size=_MAX_FRAME_BYTES,
            ws_per_message_deflate=False,  # the viewer's frames are compressed already
            timeout_graceful_shutdown=_GRACE_S,
            proxy_headers=True,
        )
    )


def _url(host: str, port: int) -> str:
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{shown}:{port}"


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


@dataclass(frozen=True)
class Backup(DataCommand):
    """Write everything that the service keeps to one zip; it may go on running meanwhile."""

    out: tyro.conf.Positional[Path]
    """FILE.zip to write; an older one is replaced once the new one is whole."""

    def run(self) -> dict[str, Any]:
        """Write the backup; return what it holds."""
        from ..storage.backup import back_up

        manifest = back_up(self.data_dir, self.out)
        self.say(f"{self.out} holds {manifest.files} files ({manifest.bytes / 1e6:.1f} MB) of {self.data_dir}.")
        return {"path": str(self.out), **manifest.model_dump()}


@dataclass(frozen=True)
class Restore(DataCommand):
    """Make a data directory from a backup; it must not exist or be empty."""

    archive: tyro.conf.Positional[Path]
    """FILE.zip that `osf backup` wrote."""

    def run(self) -> dict[str, Any]:
        """Make the folder; return what it holds."""
        from ..storage.backup import restore

        manifest = restore(self.archive, self.data_dir)
        self.say(f"{self.data_dir} holds the {manifest.files} files that were stored on {manifest.created_at}.")
        return {"data_dir": str(self.data_dir), **manifest.model_dump()}
