"""`osf photo`: a board to print, a camera calibrated with it, and objects and lamp in a photograph."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro

from osfcore.errors import InvalidInput, UnknownName, shown
from osfcore.io.files import write_atomically, write_json, writing
from osfcore.io.json_codec import encode
from osfcore.photo import calibration
from osfcore.photo.board import Board, board_of, board_pdf
from osfcore.photo.camera_files import read_camera
from osfcore.photo.read_photograph import RawPhotograph, read_photograph, to_photograph
from osfcore.photo.segmentation import Box, outline_doubt, propose_masks
from osfcore.random_streams import Stream, stream_rng

from .command import Command, DataCommand, check_out, choice_of, last_of

if TYPE_CHECKING:
    from osfcore.geometry.poses import Pose
    from osfcore.photo.photograph import Photograph
    from osfcore.photo.poses import PhotoModels, PhotoStep

_FORM = "[PHOTO:]NAME:LEFT,TOP,RIGHT,BOTTOM, such as 025_mug:120,80,260,210"


@dataclass(frozen=True)
class PhotoBoard(Command):
    """Write the calibration board, an A4 page; laid on the table it gives the place of the camera."""

    out: Path = Path("board.pdf")
    """PDF to write."""

    def run(self) -> dict[str, Any]:
        """Write the page."""
        check_out(self.out, ".pdf")
        board = Board()
        write_atomically(self.out, board_pdf(board))
        self.say(f"Wrote {self.out}. Print it at 100 %: a square is {1e3 * board.square_m:.0f} mm wide.")
        return {"out": str(self.out), "square_m": board.square_m}


@dataclass(frozen=True)
class PhotoCalibrate(Command):
    """Calibrate a camera from several photos of the board, and estimate the error to expect on the table."""

    photo: tyro.conf.Positional[tuple[Path, ...]]
    """JPEG, PNG or HEIC: three or more by one camera with one zoom, of the board tilted by 30 to 45 degrees."""
    out: Path = Path("camera.json")
    """JSON to write."""
    table: Path | None = None
    """Photo of the board lying on the table, by the camera in the place where it stays; gives that place."""
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the board's centre lies then: x and y in metres, and by how many degrees it is turned to the left."""
    board: str = ""
    """Another board than that of 'osf photo board', such as 5x7,0.04,0.03,DICT_5X5_100: squares, sides in metres."""

    def run(self) -> dict[str, Any]:
        """Calibrate; the result is what the file holds."""
        check_out(self.out, ".json")
        place = calibration.board_place(*self.place)
        board = board_of(self.board)
        views = [calibration.sight(read_photograph(path), path.name, board) for path in self.photo]
        table = None if self.table is None else calibration.sight(read_photograph(self.table), self.table.name, board)
        found = calibration.calibrated_camera(views, table, place)
        result = calibration.calibration_to_json(found, self.out.stem)
        write_json(self.out, result)
        self.say(*_camera_text(found), f"Wrote {self.out}.")
        return result


def _camera_text(found: calibration.Calibration) -> Iterator[str]:
    """The camera for people, and what would make it better."""
    for name, rms in found.rms_px.items():
        yield f"{name}: corners {rms:.2f} px from where they should appear."
    (f, _, x), (_, _, y), _ = found.lens.intrinsics.tolist()
    yield f"K: focal length {f:.1f} px (+- {found.focal_std_px:.1f}), centre {x:.1f}, {y:.1f}."
    yield f"Distortion: k1 {found.lens.radial:.3f}. Corners scatter by {found.noise_px:.2f} px."
    if found.T_world_camera is not None:
        yield f"It stands at {', '.join(f'{value:.3f}' for value in found.T_world_camera.position)} m."
    mean, worst = 1e3 * found.table.mean_m, 1e3 * found.table.worst_m
    yield f"Expected error on the table: {mean:.1f} mm, at worst {worst:.1f} mm."
    if found.advice is not None:
        yield f"One more photo would make it {1e3 * found.advice.mean_m:.1f} mm: {found.advice.words}."


@dataclass(frozen=True)
class PhotoEstimate(DataCommand):
    """Find known objects and the lamp in photographs; a box around each object, or a mask, says what to look for."""

    photo: tuple[Path, ...]
    """JPEG, PNG or HEIC; several of one table show the board, or the same objects."""
    out: Path
    """JSON to write."""
    boxes: tuple[str, ...] = ()
    """NAME:LEFT,TOP,RIGHT,BOTTOM [px] for each object; PHOTO:NAME:... if it is in another photo than the first."""
    masks: tuple[Path, ...] = ()
    """Folder with a mask of each object, NAME.png or mask_NAME.png or BOP's mask_visib; one for each photo."""
    poses: Path | None = None
    """Poses in the first photo to begin with: of BOP, PoseCNN, FoundationPose, DOPE or happypose, or .json."""
    image_id: tuple[int, ...] = ()
    """Number of each photo in files of BOP."""
    scene_id: int | None = None
    """Number of the scene in a .csv of BOP."""
    pose_source: str | None = None
    """Whose poses in a photo.json; which variable of a .mat, such as poses_icp."""
    pose_frame: Literal["bop", "ycb_video", "google_16k", "dope"] | None = None
    """Frame of objects: box's centre, YCB-Video's models, YCB's meshes, DOPE's; by default what such files have."""
    focal: float | None = None
    """Focal length in pixels; by default that of the board or the camera."""
    camera: Path | None = None
    """The camera that took the photos, from 'osf photo calibrate', ROS, OpenCV, Kalibr or RealSense, or K as .txt."""
    board: str = ""
    """Another board than that of 'osf photo board', such as 5x7,0.04,0.03,DICT_5X5_100: squares, sides in metres."""
    images: Path | None = None
    """Folder for a picture of each object: photo, outlines of mask and object, the object as found."""
    seed: int = 0
    """Of the searches."""

    def run(self) -> dict[str, Any]:
        """Estimate; the result is what the file holds."""
        from osfcore.photo.poses import PhotoConfig, PhotoModels, estimate_photo
        from osfcore.photo.summary import summarised

        photos, starts, notes, focal_known = self._inputs(self.trained.names())
        names = tuple(dict.fromkeys(name for photo in photos for name in photo.masks))
        models = PhotoModels({name: self.trained.load(name) for name in names})
        rng = stream_rng(self.seed, Stream.PHOTO_SEARCH)
        config = PhotoConfig(starts, focal_known=focal_known)
        last = last_of(estimate_photo(models, photos, names, rng, config))
        result = encode(summarised(last, models, notes, board_of(self.board)))
        write_json(self.out, result)
        if self.images is not None:
            _write_sheets(self.images, models, last)
        self.say(*_summary(result), f"Wrote {self.out}.")
        return result

    def _inputs(self, known: Collection[str]) -> tuple[tuple[Photograph, ...], dict[str, Pose], tuple[str, ...], bool]:
        """Read everything, cheap checks first.

        Args:
            known: names of objects that can be found.

        Returns:
            The photographs with cameras and masks, poses in the world to begin with, sentences for people, and
            whether focal lengths are more than guesses.

        Raises:
            OsfError: with a sentence that says what is wrong.
        """
        from osfcore.contrib.pose_files import PoseChoice, read_poses
        from osfcore.photo.summary import locate, locate_calibrated

        self._check_counts()
        camera = None if self.camera is None else read_camera(self.camera)
        board = board_of(self.board)
        raws = [read_photograph(path) for path in self.photo]
        boxes: list[dict[str, Box]] = [{} for _ in raws]
        for text in self.boxes:
            number, name, box = _box(text, self.photo, raws)
            if name not in known:
                raise UnknownName("object", name, known)
            boxes[number][name] = box
        masks = [self._masks(known, raw, boxes[number], number) for number, raw in enumerate(raws)]
        image, names = self.image_id[0] if self.image_id else None, {name for its in masks for name in its}
        choice = PoseChoice(image, self.scene_id, self.pose_source, self.pose_frame, tuple(names))
        poses = {} if self.poses is None else read_poses(self.poses, choice)
        outlines = zip(boxes, masks, strict=True)
        doubts = [outline_doubt(n, box, found[n]) for its, found in outlines for n, box in its.items()]
        photos, notes, focal_known = [], [doubt for doubt in doubts if doubt], True
        if notes:  # the search takes long
            self.say(*notes)
        for path, raw, its, marked in zip(self.photo, raws, masks, boxes, strict=True):
            found = locate(raw, self.focal, board) if camera is None else locate_calibrated(raw, camera, board)
            straight = {name: found.straightened(mask) for name, mask in its.items()}
            photo = to_photograph(found.raw, found.intrinsics, found.T_world_camera, straight)
            photos.append(photo.with_masks(straight, {name: found.straight_box(box) for name, box in marked.items()}))
            focal_known = focal_known and found.source != "assumed"
            notes += found.notes if len(raws) == 1 else [f"{path.name}: {note}" for note in found.notes]
        starts = {name: photos[0].T_world_camera @ pose for name, pose in poses.items() if name in names}
        if self.poses is not None:
            unused, missing = (", ".join(sorted(found)) for found in (set(poses) - names, names - set(poses)))
            if unused:
                notes.append(f"Poses of {unused} were not used: nothing says which pixels show them.")
            if missing:
                notes.append(f"{missing} had no pose to begin with, or several; all orientations were tried.")
        return tuple(photos), starts, tuple(notes), focal_known

    def _check_counts(self) -> None:
        count = len(self.photo)
        if not count:
            raise InvalidInput("number of photos", 0, "1 or more")
        for what, given in (("folders of masks", self.masks), ("numbers of images", self.image_id)):
            if len(given) not in (0, count):
                raise InvalidInput(f"number of {what}", len(given), f"{count}, one for each photo")
        if not self.boxes and not self.masks:
            raise InvalidInput("number of boxes", 0, "1 or more, or --masks given: an object needs a box or a mask")
        if self.camera is not None and self.focal is not None:
            raise InvalidInput("--focal", self.focal, "left out, since --camera has the focal length")

    def _masks(
        self, known: Collection[str], raw: RawPhotograph, boxes: Mapping[str, Box], number: int
    ) -> dict[str, Any]:
        """Masks of one photo: from its folder, and where there are boxes from those and clicks in their middles."""
        from osfcore.contrib.bop import read_masks

        masks: dict[str, Any] = {}
        if self.masks:
            height, width = raw.encoded.shape[:2]
            image = self.image_id[number] if self.image_id else None
            masks |= read_masks(self.masks[number], known, (raw.sent_size, (width, height)), image)
        middles = {name: np.reshape(box, (2, 2)).mean(axis=0)[None] for name, box in boxes.items()}
        return masks | propose_masks(raw.eight_bit, boxes, middles)


def _box(text: str, paths: Sequence[Path], raws: Sequence[RawPhotograph]) -> tuple[int, str, Box]:
    """Number of the photo, name, and box in pixels of the photo as it was read."""
    owner, _, numbers = text.rpartition(":")
    file, _, name = owner.rpartition(":")
    try:
        left, top, right, bottom = (float(number) for number in numbers.split(","))
    except ValueError:
        raise InvalidInput("box", text, _FORM) from None
    fitting = [k for k, path in enumerate(paths) if file in (str(path), path.name)] if file else [0]
    if len(fitting) != 1:
        raise InvalidInput("photo of a box", shown(file), f"one of {', '.join(map(str, paths))}")
    raw = raws[fitting[0]]
    width, height = raw.sent_size
    if not (max(left, 0) < min(right, width) and max(top, 0) < min(bottom, height)):  # also false for NaN
        allowed = f"within the photo's {width} x {height} pixels, given as LEFT,TOP,RIGHT,BOTTOM"
        raise InvalidInput(f"box of {shown(name)} [px]", numbers, allowed)
    scale = max(raw.encoded.shape[:2]) / max(raw.sent_size)
    return fitting[0], name, (scale * left, scale * top, scale * right, scale * bottom)


def _write_sheets(folder: Path, models: PhotoModels, step: PhotoStep) -> None:
    """NAME.png, or NAME-1.png and so on for each photo with a mask of it."""
    from osfcore.inspection.contact_sheet import write_sheet

    for found in step.found:
        for number, photo in enumerate(step.photos, 1):
            if found.name in photo.masks:
                name = found.name if len(step.photos) == 1 else f"{found.name}-{number}"
                write_sheet(folder / f"{name}.png", models, photo, found)


def _summary(result: dict[str, Any]) -> Iterator[str]:
    """The result for people: a line for each object, one for the light, the notes."""
    for entry in result["objects"]:
        x, y, z = (100 * v for v in entry["position"])
        yield f"{entry['name']} at {x:.1f}, {y:.1f}, {z:.1f} cm; its outline fits by {100 * entry['iou']:.0f} %."
        if entry["doubt"]:
            yield f"  {entry['doubt']}"
    light = result["light"]
    if light and light["diffuse"]:
        yield "The light is diffuse: the photo shows no single lamp."
    elif light:
        far = f", {light['distance_m']:.2f} m away" if light["distance_m"] is not None else ""
        yield f"Toward the lamp: {json.dumps([round(v, 2) for v in light['direction']])}{far}."
    yield from result["notes"]


@dataclass(frozen=True)
class PhotoSample(DataCommand):
    """Draw the sample photo that the page offers, from scans, with a box around each object beside it."""

    out: Path
    """Folder to write table.jpg and table.json to; made if it does not exist."""

    def run(self) -> dict[str, Any]:
        """Draw and write it."""
        from osfcore.experiments.sample_photo import BOXES, PHOTO, write_sample_photo

        with writing(self.out):
            self.out.mkdir(parents=True, exist_ok=True)
            write_sample_photo(self.assets, self.out)
        self.say(f"Wrote {self.out / PHOTO} and {self.out / BOXES}.")
        return {"photo": str(self.out / PHOTO), "boxes": str(self.out / BOXES)}


Photo = choice_of(board=PhotoBoard, calibrate=PhotoCalibrate, estimate=PhotoEstimate, sample=PhotoSample)
