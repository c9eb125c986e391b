"""Photographs of tables: taken in, marked by a person, and looked at by a job (`app.jobs.kinds.photos`)."""

from __future__ import annotations

import contextlib
import shutil
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from app.jobs.job import Job
from app.jobs.kinds.photos import FOUND, inputs_of
from app.processes.messages.photo_messages import FindMask, Mark, MaskFound, PhotoRead, ReadPhoto
from app.services.fields import FieldCatalogue
from app.services.photos.photo_looker import PhotoLooker
from app.services.runner import Runner
from app.storage.database import CannotStore, now_utc
from app.storage.records import PICTURE, STRAIGHT, Damaged, MarkedObject, TablePhoto, TablePhotoStore, mask_file
from osfcore.errors import CorruptFile, InvalidInput, NotThere, OsfError, UnknownName, check_seed
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.io.files import read_json
from osfcore.io.json_codec import decode
from osfcore.photo.calibration import KnownCamera
from osfcore.photo.found_scene import FoundScene

KIND = "photo"
_NO_FILES: Mapping[str, bytes | None] = MappingProxyType({})


class NothingMarked(OsfError):
    """A photograph in which no object was marked."""

    def __init__(self) -> None:
        super().__init__("No object is marked in this photo yet; name one and draw a box around it.")


class NotFoundYet(OsfError):
    """A photograph whose objects have not been found, or no longer since something else is marked."""

    def __init__(self) -> None:
        super().__init__("The objects of this photo have not been found yet; press Find, and wait for the end.")


@dataclass(frozen=True, slots=True)
class PhotosChanged:
    """A photograph is another one now, came or went."""


class TablePhotos:
    """The photographs of one service. Methods that change something block; any thread may call.

    Args:
        runner: does the jobs, and tells everybody what has changed.
        fields: what can be recognised.
        data_dir: of the service.
        max_photos: kept at once.

    Attributes:
        looker: that looks at photographs.
    """

    def __init__(self, runner: Runner, fields: FieldCatalogue, data_dir: Path, max_photos: int) -> None:
        self._runner, self._fields = runner, fields
        self._store = TablePhotoStore(data_dir / "photos", max_photos)
        self.looker = PhotoLooker()

    def start(self) -> None:
        """Remove what an earlier service left half done."""
        self._store.start()

    def stop(self) -> None:
        """End the process that looks at photos, if there is one. Calling it again does nothing."""
        self.looker.stop()

    # Photographs

    def all(self) -> tuple[TablePhoto, ...]:
        """All photographs, newest first."""
        return self._store.all()

    def damaged(self) -> tuple[Damaged, ...]:
        """Photographs that can only be deleted."""
        return self._store.damaged()

    def get(self, photo: str) -> TablePhoto:
        """One photograph.

        Raises:
            UnknownName: if there is none.
            CorruptFile: if it is damaged.
        """
        return self._store.get(photo)

    def picture(self, photo: str) -> Path:
        """What is shown of a photograph that exists."""
        return self._store.picture(photo)

    def mask(self, photo: str, name: str) -> Path:
        """The mask of an object that was marked."""
        return self._store.mask(photo, name)

    def receive(self, data: bytes, name: str, focal_px: float | None = None) -> TablePhoto:
        """Keep a photograph.

        Args:
            data: a picture in any usual format.
            name: for people.
            focal_px: focal length in pixels of the photo; None where nobody knows.

        Raises:
            PhotoRefused: if it cannot be used.
            InvalidInput: if the focal length makes no sense.
            ProcessUnavailable: if what decodes it died.
            TooManyPhotos: if there are too many.
            StorageFull, CannotStore: if nothing more may be written, or the disk is full.
        """
        read = self._read(data, focal_px)
        self._runner.storage.check_room()
        facts = uuid.uuid4().hex[:12], name, now_utc(), read.width, read.height, read.sent_width
        photo = TablePhoto(*facts, np.array(read.K), read.source, read.T_world_camera, read.notes)
        self._store.keep(photo, data, read.jpeg, read.straight)
        return self._told(photo)

    def set_camera(self, photo: str, focal_px: float | None, camera: KnownCamera | None = None) -> TablePhoto:
        """Look at a photograph with another focal length, in pixels of the photo as it was sent, or calibrated camera.

        Raises:
            UnknownName: if there is none.
            InvalidInput: if the focal length makes no sense, or the camera took photographs of another shape.
        """
        read = self._read(self.read(self._store.sent(photo), photo), focal_px, camera)
        facts = {"K": np.array(read.K), "source": read.source, "T_world_camera": read.T_world_camera}
        files = {PICTURE: read.jpeg, STRAIGHT: read.straight}
        return self._outdated(photo, lambda latest: replace(latest, **facts, notes=read.notes), files)

    def remove(self, photo: str) -> None:
        """Delete a photograph, damaged or not; tables and goals that were made of it stay.

        Raises:
            UnknownName: if there is none.
            CannotStore: if that is not allowed.
        """
        with contextlib.suppress(CorruptFile):  # then nobody knows which search it began
            self._end_search(self.get(photo))
        self._store.remove(photo)
        self._runner.storage.outdate()
        self._runner.hub.publish(PhotosChanged())

    # What is marked

    def mark(self, photo: str, name: str, mark: Mark) -> TablePhoto:
        """Point at an object; its mask is found.

        Raises:
            UnknownName: if there is no such photo, or no field of the object.
            InvalidInput: if the mark makes no sense, nothing is found, or too many objects are marked.
        """
        before = self.get(photo)
        if name not in (known := self._fields.names()):
            raise UnknownName("object with a field", name[:80], known)
        if len({name, *(entry.name for entry in before.objects)}) > MAX_OBJECTS:
            raise InvalidInput("number of objects in the photo", len(before.objects) + 1, f"at most {MAX_OBJECTS}")
        others = tuple(point for each in before.objects if each.name != name for point in each.mark.on)
        told = replace(mark, off=(*mark.off, *others))  # what is another object is not this one
        found = self.looker.ask(FindMask(self.read(self.picture(photo), photo), told))
        assert isinstance(found, MaskFound)
        entry = MarkedObject(name, mark, found.outline)
        return self._outdated(photo, lambda latest: latest.with_object(entry), {mask_file(name): found.png})

    def unmark(self, photo: str, name: str) -> TablePhoto:
        """Forget what was marked of an object.

        Raises:
            UnknownName: if there is no such photo, or the object was not marked.
        """

        def without(latest: TablePhoto) -> TablePhoto:
            latest.marked(name)
            return replace(latest, objects=tuple(entry for entry in latest.objects if entry.name != name))

        return self._outdated(photo, without)

    # What is found

    def find(self, photo: str, together: Sequence[str] = (), seed: int = 0) -> TablePhoto:
        """Queue the job that finds the marked objects.

        Args:
            photo: identifier.
            together: further photographs of the same table; all show the board then.
            seed: of the searches.

        Raises:
            UnknownName: if there is no such photo.
            NothingMarked: if no object is marked.
            MissingFields: if an object can no longer be recognised.
            InvalidInput: if several photographs do not all show the board.
            QueueFull, StorageFull: if too many jobs wait, or nothing more may be written.
        """
        check_seed(seed)
        photos = [self.get(each) for each in dict.fromkeys((photo, *together))]
        first = photos[0]
        if not first.objects:
            raise NothingMarked
        boards = sum(each.T_world_camera is not None for each in photos)
        if len(photos) > 1 and boards < len(photos):
            raise InvalidInput("photos with the board in view", f"{boards} of {len(photos)}", "all of them")
        names = list(dict.fromkeys(entry.name for each in photos for entry in each.objects))
        self._fields.require(names, "ours")
        self._end_search(first)
        params = {
            "photo": first.id, "title": first.name, "names": names, "seed": seed, "notes": list(first.notes),
            "photos": [_order(each) for each in photos],
        }  # fmt: skip
        with self._runner.jobs.new_inputs() as folder:
            self._copy(photos, folder)
            job = self._runner.submit_with_inputs(KIND, params, folder)
        # What was marked meanwhile is not what is looked for.
        return self.change(photo, lambda latest: replace(latest, job=job.id) if _is_same(latest, first) else latest)

    def choose(self, photo: str, name: str, choice: int) -> TablePhoto:
        """Take one of the poses that were found of an object; that settles what is doubtful about it.

        Raises:
            UnknownName: if there is no such photo or object.
            NotFoundYet: if nothing has been found yet.
            InvalidInput: if there are fewer poses.
        """
        before = self.get(photo)
        before.marked(name)
        found = {entry.name: entry for entry in self.found(before).objects}
        count = len(found[name].poses())
        if not 0 <= choice < count:
            raise InvalidInput("number of the pose", choice, f"0 to {count - 1}")
        return self.change(photo, lambda latest: latest.with_object(replace(latest.marked(name), choice=choice)))

    def doubts(self, photo: TablePhoto, found: FoundScene) -> tuple[str, ...]:
        """Why objects should not be trusted, without those of which a person has chosen a pose."""
        settled = {entry.name for entry in photo.objects if entry.choice is not None}
        return tuple(each.doubt for each in found.objects if each.doubt and each.name not in settled)

    def job(self, photo: TablePhoto) -> Job | None:
        """The estimate of what is marked now; None if there is none."""
        try:
            return None if photo.job is None else self._runner.jobs.get(photo.job, KIND)
        except UnknownName:  # it was deleted
            return None

    def found(self, photo: TablePhoto) -> FoundScene:
        """What was found.

        Raises:
            NotFoundYet: if nothing has been found yet.
            CorruptFile: if the file is damaged.
        """
        job = self.job(photo)
        if job is None or job.state != "done":
            raise NotFoundYet
        return read_json(
            self._runner.jobs.folder(job.id) / FOUND, lambda data: decode(FoundScene, data, "found objects")
        )

    # Inside

    def change(self, photo: str, changed: Callable[[TablePhoto], TablePhoto]) -> TablePhoto:
        """Keep other facts of a photograph, made of the latest ones.

        Raises:
            UnknownName: if there is none, or as `changed`.
            CannotStore: if the disk is full.
        """
        return self._told(self._store.change(photo, changed))

    def _outdated(
        self, photo: str, changed: Callable[[TablePhoto], TablePhoto], files: Mapping[str, bytes | None] = _NO_FILES
    ) -> TablePhoto:
        """Keep a photograph of which something else is to be found now; a search for what was before ends."""
        self._end_search(self.get(photo))

        def then(latest: TablePhoto) -> TablePhoto:
            after = changed(latest)
            return replace(after, objects=tuple(replace(each, choice=None) for each in after.objects), job=None)

        return self._told(self._store.change(photo, then, files))

    def _end_search(self, photo: TablePhoto) -> None:
        job = self.job(photo)
        if job is not None and not job.is_finished:
            with contextlib.suppress(OsfError):  # it has just ended by itself
                self._runner.jobs.cancel(job.id)

    def read(self, path: Path, photo: str) -> bytes:
        """A file of a photograph, which may just have been deleted.

        Raises:
            UnknownName: if so.
        """
        try:
            return path.read_bytes()
        except FileNotFoundError:
            raise NotThere("photo") from None

    def _told(self, photo: TablePhoto) -> TablePhoto:
        self._runner.hub.publish(PhotosChanged())
        return photo

    def _copy(self, photos: Sequence[TablePhoto], folder: Path) -> None:
        try:
            folder.mkdir(parents=True)
            for number, photo in enumerate(photos):
                masks = {entry.name: self.mask(photo.id, entry.name) for entry in photo.objects}
                straight = self._store.straight(photo.id)
                source = straight if straight.is_file() else self._store.sent(photo.id)
                for name, path in inputs_of(number, source, masks).items():
                    shutil.copyfile(path, folder / name)
        except OSError as error:
            raise CannotStore(folder, error.strerror or str(error)) from error

    def _read(self, data: bytes, focal_px: float | None, camera: KnownCamera | None = None) -> PhotoRead:
        read = self.looker.ask(ReadPhoto(data, focal_px, camera))
        assert isinstance(read, PhotoRead)
        return read


def _is_same(one: TablePhoto, other: TablePhoto) -> bool:
    """Whether the same is marked, in pictures of the same camera."""
    marks = ([(each.name, each.mark) for each in photo.objects] for photo in (one, other))
    return next(marks) == next(marks) and np.array_equal(one.K, other.K)


def _order(photo: TablePhoto) -> dict[str, object]:
    T = None if photo.T_world_camera is None else photo.T_world_camera.matrix().tolist()
    return {"K": photo.K.tolist(), "T_world_camera": T, "names": [entry.name for entry in photo.objects]}
