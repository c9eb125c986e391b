"""`osf assets`: list, fetch and add objects."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from osfcore.errors import OsfError
from osfcore.progress import Progress

from .command import DataCommand, choice_of, follow, show_table
from .workers import worker_pool

if TYPE_CHECKING:
    from osfcore.objects.asset_library import AssetLibrary

_TELLS_EVERY_S = 1.0


@dataclass(frozen=True)
class AssetsList(DataCommand):
    """List the objects that are known, and which of them are on this machine."""

    def run(self) -> dict[str, Any]:
        """Show the table; return its rows."""
        from osfcore.objects.catalogue import CATALOGUE

        library, rows = self.assets, []
        for name in sorted({*CATALOGUE, *library.names()}):
            try:
                rows.append(_row(library, name))
            except OsfError as error:  # a damaged object must not hide the others
                print(f"osf: {error}", file=sys.stderr)
        if not self.json:
            cells = [
                (row["name"], row["label"], _size_text(row["size_m"]), f"{row['mass_kg']:.3f}", row["symmetry"],
                 "yes" if row["available"] else "no", row["licence"])
                for row in rows
            ]  # fmt: skip
            titles = ("name", "label", "cm", "kg", "symmetry", "here", "licence")
            show_table(cells, titles, left={*titles} - {"cm", "kg"})
        return {"objects": rows, "data_dir": str(self.data_dir)}


@dataclass(frozen=True)
class AssetsFetch(DataCommand):
    """Fetch objects of the catalogue and make them ready: texture, collision parts, resting orientations."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Objects such as 006_mustard_bottle; none: all that the source offers."""
    source: str = "pypi"
    """"pypi" (ten objects), "ycb" (the official download; name what you want), a folder with
    NAME/google_16k/textured.obj, or the http(s) address of such a folder or of the archives NAME_google_16k.tgz."""
    workers: int = 2
    """Processes that convert meshes; 1 converts in this one."""
    force: bool = False
    """Fetch also what is here already."""

    def run(self) -> dict[str, Any]:
        """Fetch with a progress bar; return what is there now."""
        from osfcore.objects.fetch import fetch, source_from

        library, done = self.assets, _compiled_stamp()
        source = source_from(self.source, self.data_dir / "cache")
        chosen = self.names or source.names()
        with worker_pool(self.workers) as executor:
            # While this one downloads, so that the first episode need not wait for compilers. Objects may be here from
            # an earlier version of the program, whose compiled code does not serve this one.
            compiled = executor.submit(_compile) if executor is not None and not done.exists() else None
            follow(fetch(chosen, source, library, executor, force=self.force))
            if compiled is not None:
                follow(_waiting_for(compiled))
                if compiled.exception() is None:
                    with suppress(OSError):
                        done.touch()
        return {"objects": list(chosen), "available": list(library.names()), "data_dir": str(self.data_dir)}


@dataclass(frozen=True)
class AssetsAdd(DataCommand):
    """Add an object of your own from a textured mesh, read as the page reads it."""

    mesh: tyro.conf.Positional[Path]
    """OBJ, GLB, glTF, PLY, STL or OFF file in metres, or a zip of one with the files that it names."""
    name: str
    """What scenes call it: lower-case letters, digits, '_' and '-'."""
    mass: float | None = None
    """Mass [kg]; guessed from the volume if it is not given."""
    label: str = ""
    """Name for a person; made from the name if not given."""
    scale: float = 1.0
    """Metres for one unit of the file, such as 0.001 for millimetres."""
    licence: str = "unknown"
    """Licence of the mesh."""
    force: bool = False
    """Replace an object of that name."""

    def run(self) -> dict[str, Any]:
        """Convert and store the mesh; return its facts."""
        from osfcore.objects.fetch import NewObject, add_object

        library = self.assets
        new = NewObject(self.name, self.mass, self.label, self.scale, self.licence)
        asset = add_object(self.mesh, new, library, force=self.force)
        row = {**_row(library, self.name), "collision_parts": len(asset.parts)}
        size = _size_text(row["size_m"])
        self.say(f"Added {self.name}: {size} cm, {asset.info.mass_kg:g} kg, {len(asset.parts)} collision parts.")
        return row


Assets = choice_of(list=AssetsList, fetch=AssetsFetch, add=AssetsAdd)


def _waiting_for(compiled: Future[None]) -> Iterator[Progress]:
    """Yield how long it takes, every second, until everything is compiled or read from what was compiled before."""
    began = time.monotonic()
    while not wait([compiled], timeout=_TELLS_EVERY_S).done:
        waited = f"{time.monotonic() - began:.0f} s"
        yield Progress(0, 1, f"Preparing renderer and planner; compiling once takes minutes ({waited})")
    yield Progress(1, 1, "Renderer and planner ready")


def _compiled_stamp() -> Path:
    """A file that is there once everything of this version of the program has been compiled."""
    import osfcore
    from osfcore.objects.kernel_cache import kernel_folder

    (package,) = osfcore.__path__
    newest = max(path.stat().st_mtime_ns for path in Path(package).rglob("*.py"))
    return kernel_folder() / f"complete-{newest}-{version('numba')}"


def _compile() -> None:
    from ..jobs.kinds.rehearsal import rehearse

    rehearse()


def _row(library: AssetLibrary, name: str) -> dict[str, Any]:
    info, available = library.info(name), library.has(name)
    return {
        "name": name,
        "label": info.label,
        "size_m": [float(side) for side in library.size_m(name)] if available else None,
        "mass_kg": info.mass_kg,
        "symmetry": info.symmetry.kind,
        "symmetry_reason": info.symmetry.reason,
        "available": available,
        "licence": info.licence,
        "attribution": info.attribution,
    }


def _size_text(size_m: list[float] | None) -> str:
    return " x ".join(f"{100 * side:.0f}" for side in size_m) if size_m else ""
