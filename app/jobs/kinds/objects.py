"""The job that makes an object of an uploaded mesh: unpacked, read, given collision parts and stored."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from osfcore.errors import InvalidInput, OsfError
from osfcore.objects.fetch import NewObject, make_asset
from osfcore.progress import Progress

from ...processes.child_process import limit_cpu, limit_memory
from ..job import INPUTS
from ..kind import JobKind
from ..params import JobParams

if TYPE_CHECKING:
    from ..context import JobContext

UPLOAD = "mesh"  # in the inputs of the job
_MEMORY_BYTES = 4 << 30  # 200,000 triangles with the largest texture take 2.5 GB
_CPU_S = 300  # of all threads; the largest sound mesh takes two minutes
_STEPS = 4
_LIKELY_M = (0.03, 0.6)  # longest side of most things on a table
_UNITS = ((1.0, "metres"), (0.01, "centimetres"), (0.001, "millimetres"))


class MeshRefused(OsfError):
    """An uploaded mesh that cannot be used."""


@dataclass(frozen=True, slots=True)
class AddingStep(Progress):
    """How far the job is.

    Attributes:
        name: of the object.
        size_m: extents of its bounding box [m]; None until it has been measured.
        faces: its number of triangles; None until then.
        mass_kg: as stated, or as guessed [kg]; None until then.
    """

    name: str
    size_m: tuple[float, ...] | None = None
    faces: int | None = None
    mass_kg: float | None = None


class AddObjectParams(JobParams):
    """The object, and the name of the file that was sent."""

    name: str
    object: NewObject
    file_name: str


def add_object_job(params: AddObjectParams, place: JobContext) -> Iterator[AddingStep]:
    """Make the uploaded mesh an object; whatever is in it, this process alone may suffer from it.

    Raises:
        MeshRefused: if it cannot be used.
        OsfError: if the disk refuses.
    """
    limit_memory(_MEMORY_BYTES)
    limit_cpu(_CPU_S)
    inputs = place.folder / INPUTS
    new = params.object
    try:
        yield from _added(new, params.file_name, place)
    except MemoryError:
        raise MeshRefused("The mesh needs too much memory; simplify it, or make its texture smaller.") from None
    except OsfError as error:
        raise MeshRefused(_plain(error, new, inputs)) from error
    finally:
        shutil.rmtree(inputs, ignore_errors=True)


def _added(new: NewObject, file_name: str, place: JobContext) -> Iterator[AddingStep]:
    from osfcore.objects.mesh import read_mesh, unpack_mesh

    inputs = place.folder / INPUTS
    yield AddingStep(0, _STEPS, "Unpacking the mesh", new.name)
    mesh_file = unpack_mesh(inputs / UPLOAD, inputs / "unpacked", file_name)
    yield AddingStep(1, _STEPS, "Reading mesh and texture", new.name)
    mesh = read_mesh(mesh_file, new.scale, inputs / "unpacked")
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = tuple(round(float(side), 6) for side in high - low)
    info = new.info(mesh)
    measured = new.name, size, len(mesh.faces), info.mass_kg
    yield AddingStep(2, _STEPS, "Making collision shapes and resting orientations", *measured)
    asset = make_asset(mesh, info)
    yield AddingStep(3, _STEPS, "Storing the object", *measured)
    if (place.library.root / new.name).exists():
        raise InvalidInput("object name", repr(new.name), "one that is not taken yet")
    place.library.write(asset, f"upload of {file_name}")
    yield AddingStep(_STEPS, _STEPS, "Ready", *measured)


def _plain(error: OsfError, new: NewObject, inputs: Path) -> str:
    """The error in words that the uploader knows."""
    from osfcore.objects.mesh import WrongMeshSize

    if isinstance(error, WrongMeshSize):
        raw = error.longest_m / new.scale
        fitting = [unit for metres, unit in _UNITS if _LIKELY_M[0] <= raw * metres <= _LIKELY_M[1]]
        advice = f"choose the unit {fitting[0]}" if fitting else "choose another unit or scale"
        return f"The mesh is {_length(error.longest_m)} long, but it must be between 5 mm and 1 m; {advice}."
    text = str(error).replace(str(inputs / UPLOAD), "the uploaded file")
    return text[:1].upper() + text[1:] if text.startswith("the ") else text


def _length(metres: float) -> str:
    if metres >= 1:
        return f"{metres:,.3g} m" if metres < 1000 else f"{metres:,.0f} m"
    return f"{1000 * metres:.3g} mm"


ADD_OBJECT = JobKind("add_object", "new object", add_object_job, AddObjectParams)
