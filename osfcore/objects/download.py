"""Downloading and unpacking of files, with limits on size and time. Files appear complete or not at all."""

from __future__ import annotations

import contextlib
import http.client
import os
import re
import subprocess
import sys
import tarfile
import time
import urllib.error
import urllib.request
import zlib
from collections.abc import Iterator
from pathlib import Path

from osfcore.errors import CorruptFile, FetchFailed
from osfcore.io.files import put_in_place, scratch_folder

MAX_BYTES = 300_000_000
TIMEOUT_S = 30.0
TRIES = 3
_PAUSE_S = 0.5
_CHUNK_BYTES = 1 << 20
_TEMPORARY_PREFIX = ".fetching-"
_TEMPORARY_LIFE_S = 3600  # older folders were left by a killed process


@contextlib.contextmanager
def raising_fetch_failed(what: str, place: Path) -> Iterator[None]:
    """Turn an `OSError`, such as a full disk, into `FetchFailed`."""
    try:
        yield
    except OSError as error:
        raise FetchFailed(what, f"{place} cannot be written ({error.strerror or error})") from error


@contextlib.contextmanager
def temporary_folder(parent: Path, what: str) -> Iterator[Path]:
    """Yield a folder inside `parent` that is deleted afterwards, together with old folders of killed processes.

    Raises:
        FetchFailed: if it cannot be created.
    """
    with contextlib.ExitStack() as stack:
        with raising_fetch_failed(what, parent):
            folder = stack.enter_context(scratch_folder(parent, _TEMPORARY_PREFIX, _TEMPORARY_LIFE_S))
        yield folder


def download(address: str, path: Path, max_bytes: int = MAX_BYTES) -> bool:
    """Download a file from an http(s) address, with a few tries; return False if the server does not have it.

    Args:
        address: URL.
        path: file to write. An older one is replaced.
        max_bytes: largest size that is accepted [bytes].

    Raises:
        FetchFailed: if the server cannot be reached, answers with an error, sends too much or breaks off, or the disk
            is full. `path` then does not exist.
    """
    reason = ""
    for attempt in range(TRIES):
        if attempt:
            time.sleep(_PAUSE_S * attempt)
        try:
            request = urllib.request.Request(address, headers={"User-Agent": "osf"})
            with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
                _save(answer, path, max_bytes, address)
            return True
        except urllib.error.HTTPError as error:
            error.close()
            if error.code in (403, 404, 410):  # object stores answer 403 for files that they do not have
                return False
            reason = f"the server answered {error.code} {error.reason}"
            if error.code < 500:
                break
        except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
            reason = f"no connection, check the network ({getattr(error, 'reason', None) or error})"
    raise FetchFailed(address, reason)


def _save(answer: http.client.HTTPResponse, path: Path, max_bytes: int, address: str) -> None:
    expected = answer.headers.get("Content-Length")
    size = 0
    part = path.with_name(path.name + ".part")
    try:
        with raising_fetch_failed(address, path.parent):
            file = part.open("wb")
        with file:
            while chunk := answer.read(_CHUNK_BYTES):
                size += len(chunk)
                if size > max_bytes:
                    raise FetchFailed(address, f"it is larger than {max_bytes / 1e6:.0f} MB")
                with raising_fetch_failed(address, path.parent):
                    file.write(chunk)
        if expected is not None and size != int(expected):
            raise ConnectionError(f"{size} of {expected} bytes arrived")
        with raising_fetch_failed(address, path.parent):
            put_in_place(part, path)
    finally:
        part.unlink(missing_ok=True)


def unpack(archive: Path, folder: Path, max_bytes: int = MAX_BYTES) -> None:
    """Unpack a tar archive. None of its files can be written outside the folder.

    Args:
        archive: a .tar file, which may be compressed.
        folder: folder to write to.
        max_bytes: largest sum of its files' sizes that is accepted [bytes].

    Raises:
        CorruptFile: if it is damaged, too large or holds anything but plain files and folders inside `folder`.
        FetchFailed: if the disk is full.
    """
    try:
        with tarfile.open(archive) as tar:
            size = 0
            for member in tar:
                size += member.size
                if size > max_bytes:
                    raise CorruptFile(archive, f"it unpacks to more than {max_bytes / 1e6:.0f} MB")
                if not (member.isfile() or member.isdir()):
                    raise CorruptFile(archive, f"it holds {member.name!r}, which is neither a file nor a folder")
                tar.extract(member, folder, filter="data")
            for _ in range(0, max_bytes, _CHUNK_BYTES):  # gzip compares checksums only at its end
                if tar.fileobj is None or not tar.fileobj.read(_CHUNK_BYTES):
                    break
    except CorruptFile:
        raise
    except (tarfile.TarError, EOFError) as error:
        raise CorruptFile(archive, "it is a damaged or unsafe archive") from error
    except OSError as error:
        if error.errno is None or "gzip" in str(error).lower():
            raise CorruptFile(archive, "it is a damaged archive") from error
        raise FetchFailed(archive.name, f"{folder} cannot be written ({error.strerror})") from error
    except (ValueError, zlib.error) as error:
        raise CorruptFile(archive, "it is a damaged archive") from error


def pip_download(requirement: str, folder: Path) -> Iterator[int]:
    """Download one wheel into `folder` with pip, without dependencies; yield the bytes that have arrived so far.

    Raises:
        FetchFailed: if pip is missing or fails; the reason is pip's last message.
    """
    scratch = folder / "pip"
    scratch.mkdir()
    command = [sys.executable, "-m", "pip", "download", requirement, "--no-deps", "--only-binary=:all:"]
    command += ["--no-input", "--disable-pip-version-check", "--no-cache-dir", "--progress-bar=off", "--retries=2"]
    command += [f"--timeout={TIMEOUT_S:.0f}", f"--dest={folder}"]
    log_path = folder / "pip.log"
    with log_path.open("wb") as log:
        # pip loads into its temporary folder first: in ours it is seen by the progress bar and cleaned up after a kill.
        environment = {**os.environ, "TMPDIR": str(scratch)}
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)
    try:
        while True:
            yield sum(path.stat().st_size for path in scratch.rglob("*.whl") if path.is_file())
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=0.5)
                break
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait()
    if process.returncode:
        raise FetchFailed(requirement, _pip_reason(log_path.read_text(encoding="utf-8", errors="replace")))


def _pip_reason(log: str) -> str:
    if "No module named pip" in log:
        return f"{sys.executable} has no pip; install it with 'python -m ensurepip'"
    if "No space left" in log:
        return "the disk is full (No space left on device)"
    if re.search("NewConnectionError|NameResolutionError|ConnectTimeout|Read timed out|ProxyError", log):
        return "the package index cannot be reached; check the network and the proxy settings of pip"
    said = re.findall("^ERROR: (.*)", log, flags=re.MULTILINE)
    return "pip says: " + (said[-1].rstrip(".") if said else "nothing")
