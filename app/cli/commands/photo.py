"""`osf photo`: a board to print, and objects and lamp in a photograph."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir
from osfcore.errors import InvalidInput

if TYPE_CHECKING:
    from osfcore.photo.photograph import Photograph
    from osfcore.photo.poses.estimate_photo import PhotoModels
    from osfcore.photo.poses.photo_steps import PhotoPose, PhotoStep
    from osfcore.photo.read_photograph import RawPhotograph


@dataclass(frozen=True)
class PhotoBoard:
    """Write the calibration board, an A4 page; laid on the table it tells where the camera was."""

    out: Path = Path("board.pdf")
    """PDF to write."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Write the page."""
        from osfcore.io.files import write_atomically
        from osfcore.photo.board import Board
        from osfcore.photo.board_page import board_pdf

        if self.out.suffix.lower() != ".pdf":
            raise InvalidInput("output file", self.out, "a path that ends in .pdf")
        board = Board()
        write_atomically(self.out, board_pdf(board))
        if not self.json:
            print(f"Wrote {self.out}. Print it at 100 %: a square is {1e3 * board.square_m:.0f} mm wide.")
        return {"out": str(self.out), "square_m": board.square_m}


@dataclass(frozen=True)
class PhotoEstimate:
    """Find known objects and the lamp in a photograph; a box around each object says what to look for."""

    photo: Path
    """JPEG, PNG or HEIC."""
    boxes: tuple[str, ...]
    """NAME:LEFT,TOP,RIGHT,BOTTOM in pixels of the photo, one for each object."""
    out: Path
    """JSON to write."""
    focal: float | None = None
    """Focal length in pixels; by default what the board or the camera tells."""
    images: Path | None = None
    """Folder for a picture of each object: photo, outlines of mask and object, the object as found."""
    seed: int = 0
    """Of the searches."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where trained fields are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Estimate; the result is what the file holds."""
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.inspection.photo_sheet import write_sheet
        from osfcore.io.files import write_json
        from osfcore.photo.poses.estimate_photo import PhotoModels, estimate_photo
        from osfcore.photo.read_photograph import read_photograph
        from osfcore.random_streams import Stream, stream_rng

        raw = read_photograph(self.photo)
        boxes = dict(_box(text, raw) for text in self.boxes)
        photo, notes = self._located(raw)
        photo = photo.with_masks(_masks(raw, boxes))
        fields = FieldLibrary(self.data_dir)
        models = PhotoModels({name: fields.load(name) for name in boxes})
        rng = stream_rng(self.seed, Stream.PHOTO_SEARCH)
        last = follow(_Shown(step.progress.done, step.progress.total, step.progress.note, step)
                      for step in estimate_photo(models, [photo], tuple(boxes), rng))  # fmt: skip
        assert last is not None
        result = _result(photo, last.step, models, notes)
        write_json(self.out, result)
        if self.images is not None:
            for found in last.step.found:
                write_sheet(self.images / f"{found.name}.png", models, photo, found)
        if not self.json:
            _show(result, self.out)
        return result

    def _located(self, raw: RawPhotograph) -> tuple[Photograph, list[str]]:
        """The photograph with its camera: over the board if it shows one."""
        from osfcore.photo.board import Board, locate_board
        from osfcore.photo.read_photograph import guessed_intrinsics, intrinsics_from_focal, to_photograph

        height, width = raw.encoded.shape[:2]
        scale = max(height, width) / max(raw.sent_size)
        given = None if self.focal is None else intrinsics_from_focal(width, height, scale * self.focal)
        try:
            view = locate_board(raw.eight_bit, Board(), given)
        except InvalidInput as error:
            K, note = (given, "") if given is not None else guessed_intrinsics(raw)
            unknown = f"No board tells where the table is ({error})"
            return to_photograph(raw, K), [*raw.notes, *([note] if note else []), unknown]
        return to_photograph(raw, view.intrinsics, view.T_world_camera), list(raw.notes)


@dataclass(frozen=True)
class _Shown:
    """A step as a progress bar takes it."""

    done: int
    total: int
    note: str
    step: PhotoStep


def _box(text: str, raw: RawPhotograph) -> tuple[str, tuple[float, float, float, float]]:
    """Name and box of an argument, in pixels of the photo as it was read."""
    name, _, numbers = text.rpartition(":")
    try:
        left, top, right, bottom = (float(number) for number in numbers.split(","))
    except ValueError:
        raise InvalidInput("box", text, "NAME:LEFT,TOP,RIGHT,BOTTOM, such as 025_mug:120,80,260,210") from None
    scale = max(raw.encoded.shape[:2]) / max(raw.sent_size)
    return name, (scale * left, scale * top, scale * right, scale * bottom)


def _masks(raw: RawPhotograph, boxes: dict[str, tuple[float, float, float, float]]) -> dict[str, Any]:
    """A mask of each object: around it a box, in its middle a click."""
    import numpy as np

    from osfcore.photo.segmentation import propose_mask

    masks = {}
    for name, (left, top, right, bottom) in boxes.items():
        middle = np.array([[(left + right) / 2, (top + bottom) / 2]])
        masks[name] = propose_mask(raw.eight_bit, (left, top, right, bottom), middle)
    return masks


def _result(photo: Photograph, step: PhotoStep, models: PhotoModels, notes: list[str]) -> dict[str, Any]:
    """What the file holds, in the table's frame where there is one."""
    from osfcore.geometry.poses import Pose

    T_table_world, table = Pose.identity(), "board" if photo.on_table else None
    if step.table is not None:
        T_table_world, table = step.table.T_world_camera, "objects"
        count, spread = len(step.table.supported), step.table.spread_deg
        seen = f"The table was found from how {count} objects lie, whose verticals differ by {spread:.1f} degrees"
        notes = [*notes, f"{seen}; it may be off by a few."]

    def entry(found: PhotoPose) -> dict[str, Any]:
        pose = T_table_world @ found.pose
        return {"position": pose.position.tolist(), "quaternion": pose.quaternion.tolist(), "loss": found.loss,
                "iou": found.iou}  # fmt: skip

    objects = [
        {"name": o.name, **entry(o.best), "doubt": o.doubt, "rivals": [entry(r) for r in o.rivals]} for o in step.found
    ]
    lamp, unknown = _lamp(photo, step, models)
    T_table_camera = (T_table_world @ photo.T_world_camera).matrix()
    camera = {"K": photo.intrinsics.tolist(), "T_world_camera": T_table_camera.tolist(), "width": photo.width,
              "height": photo.height}  # fmt: skip
    return {"table": table, "objects": objects, "light": lamp, "camera": camera, "notes": [*notes, *unknown]}


def _lamp(photo: Photograph, step: PhotoStep, models: PhotoModels) -> tuple[dict[str, Any], list[str]]:
    """The lamp in the table's frame where there is one, and what is not known of it, in sentences."""
    import numpy as np

    from osfcore.photo.board_page import PAGE_M
    from osfcore.photo.light.photo_light import photo_lamp, photo_light
    from osfcore.photo.poses.estimate_photo import FINE_ACROSS

    surfels, found = [models.surfels(o.name, FINE_ACROSS) for o in step.found], step.found
    if step.table is None and not photo.on_table:
        light = photo_light(photo, found, surfels)
        lamp = {"direction": light.direction.tolist(), "std_deg": float(np.rad2deg(light.std)), "diffuse":
                light.is_diffuse, "distance_m": None, "distance_std_m": None}  # fmt: skip
        return lamp, ["How far away the lamp is, cannot be told without a known table."]
    covered = PAGE_M
    if step.table is not None:
        place, covered = step.table.T_world_camera, None
        photo = replace(photo, T_world_camera=place, on_table=True)
        found = [replace(o, best=replace(o.best, pose=place @ o.best.pose)) for o in found]
    light = photo_lamp([photo], found, surfels, covered_m=covered)
    known = light.distance_known
    lamp = {"direction": light.direction.tolist(), "std_deg": float(np.rad2deg(light.std)),
            "diffuse": light.is_diffuse, "distance_m": light.distance if known else None,
            "distance_std_m": light.distance * light.log_distance_std if known else None}  # fmt: skip
    if known or light.is_diffuse:
        return lamp, []
    return lamp, ["How far away the lamp is, cannot be told: a distant one would look the same."]


def _show(result: dict[str, Any], out: Path) -> None:
    """The result for people: a line for each object, one for the light, the notes."""
    for entry in result["objects"]:
        x, y, z = (100 * v for v in entry["position"])
        print(f"{entry['name']} at {x:.1f}, {y:.1f}, {z:.1f} cm; its outline fits by {100 * entry['iou']:.0f} %.")
        if entry["doubt"]:
            print(f"  {entry['doubt']}")
    if result["light"]["diffuse"]:
        print("The light is diffuse: nothing speaks for one lamp.")
    else:
        light = result["light"]
        far = f", {light['distance_m']:.2f} m away" if light["distance_m"] is not None else ""
        print(f"Toward the lamp: {json.dumps([round(v, 2) for v in light['direction']])}{far}.")
    print("\n".join([*result["notes"], f"Wrote {out}."]))


Photo = Annotated[
    Annotated[PhotoBoard, tyro.conf.subcommand("board")] | Annotated[PhotoEstimate, tyro.conf.subcommand("estimate")],
    tyro.conf.OmitSubcommandPrefixes,
]
