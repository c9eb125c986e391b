"""The import rules of docs/explanation/architecture.md, checked on the source text."""

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import app
import osfcore

ROOT = Path(__file__).parents[1]
# A module may import from rooms above it in this list (and its own), never from rooms below it.
ROOMS = (
    "osfcore.errors",
    "osfcore.extras",
    "osfcore.progress",
    "osfcore.random_streams",
    "osfcore.plugins",
    "osfcore.geometry",
    "osfcore.io",
    "osfcore.objects",
    "osfcore.metrics",
    "osfcore.fields",
    "osfcore.render",
    "osfcore.estimation",
    "osfcore.photo",
    "osfcore.dynamics",
    "osfcore.planning",
    "osfcore.control",
    "osfcore.paper",
    "osfcore.world",
    "osfcore.contrib",
    "osfcore.inspection",
    "osfcore.experiments",
    "app.processes",
    "app.storage",
    "app.viewer.nodes",
    "app.episodes",
    "app.jobs",
    "app.services",
    "app.viewer",
    "app.api",
    "app.cli",
)
OWNERS = {  # who alone may import a package
    "pybullet": ("osfcore.world.bullet_physics",),
    "mujoco": ("osfcore.world.mujoco_physics",),
    "embreex": ("osfcore.world.embree",),
    "httpx2": ("osfcore.contrib.client", "osfcore.contrib.robots.http_robot"),
    "cma": ("osfcore.estimation.search",),
    "coacd": ("osfcore.geometry.convex_parts",),
    "viser": ("app.viewer", "app.episodes.recording", "app.api.relay"),
    "websockets": ("app.api.relay", "app.viewer.private_server", "osfcore.contrib.robots.ros_robot"),
    "gymnasium": ("osfcore.contrib.tabletop_env",),
    "gym_pusht": ("osfcore.experiments.pusht",),
    "pytorch_mppi": ("osfcore.experiments.pusht",),
    "foxglove": ("app.episodes.mcap",),
    "imageio_ffmpeg": ("osfcore.io.video_file",),
    "pxr": ("osfcore.contrib.export.usd",),
    "pyarrow": ("osfcore.contrib.export.lerobot",),
    "mcp": ("osfcore.contrib.mcp_server",),
    "fastapi": ("app",),
    "uvicorn": ("app",),
    "tyro": ("app",),
    "submitit": ("app.cli.cluster_jobs",),
    "osfcore.experiments": ("osfcore.experiments", "app.cli"),
}
SOURCES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in ("osfcore", "app")
    for path in sorted((ROOT / package).rglob("*.py"))
}
TREES = {module: ast.parse(path.read_text()) for module, path in SOURCES.items()}


def imported(module: str) -> set[str]:
    """Modules that a module imports anywhere in its file, also inside functions."""
    found = set()
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = module.split(".") if SOURCES[module].name == "__init__.py" else module.split(".")[:-1]
            parts = [*package[: len(package) - node.level + 1] * bool(node.level), *(node.module or "").split(".")]
            source = ".".join(filter(None, parts))
            names = {f"{source}.{alias.name}" for alias in node.names}
            found |= {name if name in SOURCES else source for name in names}
    return found


IMPORTS = {module: imported(module) for module in SOURCES}


def within(module: str, room: str) -> bool:
    return module == room or module.startswith(room + ".")


def floor(module: str) -> int | None:
    """The place in the list of the narrowest room that holds a module."""
    rooms = [room for room in ROOMS if within(module, room)]
    return ROOMS.index(max(rooms, key=len)) if rooms else None


def test_imports_go_one_way():
    for module, names in IMPORTS.items():
        mine = floor(module)
        above = [n for n in names if mine is not None and (theirs := floor(n)) is not None and theirs > mine]
        assert not above, f"{module} imports {above}"


def test_packages_are_imported_by_their_owners_alone():
    for module, names in IMPORTS.items():
        for package, owners in OWNERS.items():
            if any(within(name, package) for name in names):
                assert any(within(module, owner) for owner in owners), f"{module} imports {package}"


def test_no_two_files_import_each_other():
    try:
        TopologicalSorter({m: names & SOURCES.keys() - {m} for m, names in IMPORTS.items()}).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_core_neither_prints_nor_works_at_import():
    allowed = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign, ast.If, ast.Expr)
    for module, tree in TREES.items():
        if module.startswith("osfcore"):
            calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
            assert "print" not in {call.func.id for call in calls}, module
            assert all(isinstance(node, allowed) for node in tree.body), module


def test_every_module_imports_and_its_public_names_exist():
    for package in (app, osfcore):
        for info in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            if not info.name.endswith("__main__"):
                module = importlib.import_module(info.name)
                for name in getattr(module, "__all__", ()):
                    assert hasattr(module, name), f"{info.name}.{name}"


@pytest.mark.slow
def test_web_process_starts_without_heavy_packages():
    """The page must be there within seconds: physics, torch and decomposition load in other processes."""
    heavy = ("torch", "pybullet", "coacd", "h5py", "numba")
    code = f"import sys, app.api.app_factory; print(*(m for m in {heavy} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_no_two_modules_of_the_page_import_each_other():
    modules = {path.name: path.read_text() for path in (ROOT / "static" / "js").glob("*.js")}
    uses = {name: set(re.findall(r'from "\./([\w-]+\.js)"', text)) for name, text in modules.items()}
    assert any(uses.values())
    assert set().union(*uses.values()) <= set(modules)
    TopologicalSorter(uses).prepare()  # raises an error that names the modules of a circle


def test_the_page_asks_nobody_else():
    for path in (ROOT / "static").rglob("*"):
        if path.suffix in {".html", ".js", ".css"} and "vendor" not in path.parts:
            for url in re.findall(r"https?://[^\s\"'`)<]+", path.read_text()):
                assert url.startswith(
                    ("http://www.w3.org/", "https://ycbbenchmarks.com", "https://www.ycbbenchmarks.com")
                ), url
