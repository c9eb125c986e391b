"""`osf photo`: a board to print, a camera calibrated with it, and objects and lamp in a photograph."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir
from osfcore.errors import InvalidInput

if TYPE_CHECKING:
    from osfcore.photo.calibration import Calibration
    from osfcore.photo.photograph import Photograph
    from osfcore.photo.poses import PhotoModels, PhotoStep


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
        from osfcore.photo.board import Board, board_pdf

        if self.out.suffix.lower() != ".pdf":
            raise InvalidInput("output file", self.out, "a path that ends in .pdf")
        board = Board()
        write_atomically(self.out, board_pdf(board))
        if not self.json:
            print(f"Wrote {self.out}. Print it at 100 %: a square is {1e3 * board.square_m:.0f} mm wide.")
        return {"out": str(self.out), "square_m": board.square_m}


@dataclass(frozen=True)
class PhotoCalibrate:
    """Calibrate a camera from several photos of the board, and tell the error to expect on the table."""

    photo: tyro.conf.Positional[tuple[Path, ...]]
    """JPEG, PNG or HEIC: three or more by one camera with one zoom, of the board tilted by 30 to 45 degrees."""
    out: Path = Path("camera.json")
    """JSON to write."""
    table: Path | None = None
    """Photo of the board lying on the table, by the camera in the place where it stays; tells where it stands."""
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the board's centre lies then: x and y in metres, and by how many degrees it is turned to the left."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Calibrate; the result is what the file holds."""
        from osfcore.io.files import write_json
        from osfcore.photo.calibration import board_place, calibrated_camera, calibration_to_json, sight
        from osfcore.photo.read_photograph import read_photograph

        if self.out.suffix.lower() != ".json":
            raise InvalidInput("output file", self.out, "a path that ends in .json")
        place = board_place(*self.place)
        views = [sight(read_photograph(path), path.name) for path in self.photo]
        table = None if self.table is None else sight(read_photograph(self.table), self.table.name)
        found = calibrated_camera(views, table, place)
        result = calibration_to_json(found, self.out.stem)
        write_json(self.out, result)
        if not self.json:
            _show_camera(found, self.out)
        return result


def _show_camera(found: Calibration, out: Path) -> None:
    """The camera for people, and what would make it better."""
    for name, rms in found.rms_px.items():
        print(f"{name}: corners {rms:.2f} px from where they should appear.")
    (f, _, x), (_, _, y), _ = found.lens.intrinsics.tolist()
    print(f"K: focal length {f:.1f} px (+- {found.focal_std_px:.1f}), centre {x:.1f}, {y:.1f}.")
    print(f"Distortion: k1 {found.lens.radial:.3f}. Corners scatter by {found.noise_px:.2f} px.")
    if found.T_world_camera is not None:
        print(f"It stands at {', '.join(f'{value:.3f}' for value in found.T_world_camera.position)} m.")
    print(
        f"Expected error on the table: {1e3 * found.table.mean_m:.1f} mm, at worst {1e3 * found.table.worst_m:.1f} mm."
    )
    if found.advice is not None:
        print(f"One more photo would make it {1e3 * found.advice.mean_m:.1f} mm: {found.advice.words}.")
    print(f"Wrote {out}.")


@dataclass(frozen=True)
class PhotoEstimate:
    """Find known objects and the lamp in photographs; a box around each object, or a mask, says what to look for."""

    photo: tuple[Path, ...]
    """JPEG, PNG or HEIC; several of one table must all show the board."""
    out: Path
    """JSON to write."""
    boxes: tuple[str, ...] = ()
    """NAME:LEFT,TOP,RIGHT,BOTTOM [px] for each object; PHOTO:NAME:... if it is in another photo than the first."""
    masks: tuple[Path, ...] = ()
    """Folder with a mask of each object, NAME.png or mask_NAME.png or BOP's mask_visib; one for each photo."""
    poses: Path | None = None
    """Poses in the first photo to begin with: BOP's .csv or scene_gt.json, PoseCNN's .mat, or .json."""
    image_id: tuple[int, ...] = ()
    """Number of each photo in files of BOP."""
    scene_id: int | None = None
    """Number of the scene in a .csv of BOP."""
    pose_source: str | None = None
    """Whose poses in a photo.json; which variable of a .mat, such as poses_icp."""
    pose_frame: Literal["bop", "ycb_video", "google_16k"] | None = None
    """Origin of objects: box's centre, YCB-Video's models, or YCB's meshes; by default what such files usually have."""
    focal: float | None = None
    """Focal length in pixels; by default what the board or the camera tells."""
    camera: Path | None = None
    """What 'osf photo calibrate' has written about the camera that took the photos."""
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
        from app.cli.commands.photo_inputs import Asked, read_inputs
        from osfcore.contrib.bop import PoseChoice
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.io.files import write_json
        from osfcore.io.json_codec import encode
        from osfcore.photo.poses import PhotoConfig, PhotoModels, estimate_photo
        from osfcore.photo.summary import summarised
        from osfcore.random_streams import Stream, stream_rng

        fields = FieldLibrary(self.data_dir)
        choice = PoseChoice(None, self.scene_id, self.pose_source, self.pose_frame)
        asked = Asked(self.photo, self.boxes, self.masks, self.poses, choice, self.image_id, self.focal, self.camera)
        ready = read_inputs(asked, fields.names())
        models = PhotoModels({name: fields.load(name) for name in ready.names})
        rng = stream_rng(self.seed, Stream.PHOTO_SEARCH)
        steps = estimate_photo(models, ready.photos, ready.names, rng, PhotoConfig(ready.starts))
        last = follow(_Shown(step.progress.done, step.progress.total, step.progress.note, step) for step in steps)
        assert last is not None
        result = encode(summarised(ready.photos, last.step, models, ready.notes))
        write_json(self.out, result)
        if self.images is not None:
            _write_sheets(self.images, models, ready.photos, last.step)
        if not self.json:
            _show(result, self.out)
        return result


@dataclass(frozen=True)
class _Shown:
    """A step as a progress bar takes it."""

    done: int
    total: int
    note: str
    step: PhotoStep


def _write_sheets(folder: Path, models: PhotoModels, photos: Sequence[Photograph], step: PhotoStep) -> None:
    """NAME.png, or NAME-1.png and so on for each photo with a mask of it."""
    from osfcore.inspection.contact_sheet import write_sheet

    for found in step.found:
        for number, photo in enumerate(photos, 1):
            if found.name in photo.masks:
                name = found.name if len(photos) == 1 else f"{found.name}-{number}"
                write_sheet(folder / f"{name}.png", models, photo, found)


def _show(result: dict[str, Any], out: Path) -> None:
    """The result for people: a line for each object, one for the light, the notes."""
    for entry in result["objects"]:
        x, y, z = (100 * v for v in entry["position"])
        print(f"{entry['name']} at {x:.1f}, {y:.1f}, {z:.1f} cm; its outline fits by {100 * entry['iou']:.0f} %.")
        if entry["doubt"]:
            print(f"  {entry['doubt']}")
    if result["light"] and result["light"]["diffuse"]:
        print("The light is diffuse: nothing speaks for one lamp.")
    elif result["light"]:
        light = result["light"]
        far = f", {light['distance_m']:.2f} m away" if light["distance_m"] is not None else ""
        print(f"Toward the lamp: {json.dumps([round(v, 2) for v in light['direction']])}{far}.")
    print("\n".join([*result["notes"], f"Wrote {out}."]))


Photo = Annotated[
    Annotated[PhotoBoard, tyro.conf.subcommand("board")]
    | Annotated[PhotoCalibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[PhotoEstimate, tyro.conf.subcommand("estimate")],
    tyro.conf.OmitSubcommandPrefixes,
]
