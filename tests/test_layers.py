"""Rules of the house that no reviewer should have to check by hand."""

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import app
import osfcore

ROOT = Path(__file__).parents[1]
# A module may import from rooms to its left (and its own), never from rooms to its right.
ROOMS = (
    "errors",
    "files",
    "poses",
    "progress",
    "scene",
    "estimated",
    "scenefile",
    "statefile",
    "observationfile",
    "pushfile",
    "rollouts",
    "rolloutfile",
    "convex",
    "fields",
    "render",
    "estimate",
    "dynamics",
    "plan",
    "baselines",
    "objects",
    "world",
    "control",
    "observation_overlay",
    "check",
    "evaluate",
)
OWNERS = {  # who alone may import a package
    "pybullet": ("osfcore/world/physics.py", "osfcore/world/tiny.py"),
    "embreex": ("osfcore/world/traced.py",),
    "cma": ("osfcore/estimate/evolution.py",),
    "coacd": ("osfcore/convex.py",),
    "viser": ("app/viewer/", "app/relay.py"),
    "websockets": ("app/relay.py",),
    "imageio_ffmpeg": ("app/episode/frames.py",),
    "fastapi": ("app/",),
    "uvicorn": ("app/",),
    "tyro": ("app/",),
}
SOURCES = sorted(path for package in ("osfcore", "app") for path in (ROOT / package).rglob("*.py"))


def imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", [p for p in SOURCES if p.parts[-2:] != ("osfcore", "__init__.py")], ids=relative)
def test_imports_go_one_way(path):
    name = relative(path)
    for imported in imports(path):
        top = imported.split(".")[0]
        if top in OWNERS:
            assert name.startswith(OWNERS[top]), f"{name} imports {top}"
        if name.startswith("osfcore/"):
            assert top != "app", f"{name} imports the app"
            if top == "osfcore" and "." in imported:
                mine = name.split("/")[1].removesuffix(".py")
                assert ROOMS.index(imported.split(".")[1]) <= ROOMS.index(mine), f"{name} imports {imported}"


@pytest.mark.parametrize("path", [p for p in SOURCES if "osfcore" in p.parts], ids=relative)
def test_core_neither_prints_nor_works_at_import(path):
    tree = ast.parse(path.read_text())
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    assert "print" not in {call.func.id for call in calls}
    allowed = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign, ast.If)
    docstring = (ast.Expr,)
    assert all(isinstance(node, allowed + docstring) for node in tree.body)


@pytest.mark.parametrize("package", [app, osfcore], ids=lambda p: p.__name__)
def test_every_module_imports_and_its_public_names_exist(package):
    for info in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if info.name.endswith("__main__"):
            continue
        module = importlib.import_module(info.name)
        for name in getattr(module, "__all__", ()):
            assert hasattr(module, name), f"{info.name}.{name}"


@pytest.mark.parametrize("path", [p for p in SOURCES if p.name != "__init__.py"], ids=relative)
def test_every_module_has_a_test_file(path):
    where = ROOT / "tests" / ("core" if "osfcore" in path.parts else "app")
    folder = path.relative_to(ROOT).parts[1:-1]
    untested = {"osfcore/objects/asset.py", "osfcore/world/protocol.py"}  # types without behaviour
    if relative(path) not in untested:
        assert (where.joinpath(*folder) / f"test_{path.stem}.py").exists()


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_files_stay_small(path):
    assert len(path.read_text().splitlines()) <= 450


def test_web_process_starts_without_heavy_packages():
    """The page must be there within seconds: physics, torch and decomposition load in other processes."""
    code = (
        "import sys, app.main; print(*(m for m in ('torch', 'pybullet', 'coacd', 'h5py', 'numba') if m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_the_page_asks_nobody_else():
    for path in (ROOT / "static").rglob("*"):
        if path.suffix in {".html", ".js", ".css"}:
            for url in re.findall(r"https?://[^\s\"'`)<]+", path.read_text()):
                assert url.startswith(
                    ("http://www.w3.org/", "https://ycbbenchmarks.com", "https://www.ycbbenchmarks.com")
                ), url
