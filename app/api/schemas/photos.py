"""Requests and responses that concern photographs of tables. Places are pixels of the photo as `photo.jpg` shows it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import BaseModel, Field, FiniteFloat

from app.api.schemas.calibration import CameraIn
from app.api.schemas.common import Input, SceneOut, Seed
from app.api.schemas.goals import GoalOut
from app.api.schemas.jobs import JobOut
from app.api.schemas.limits import (
    BRUSH,
    CLICKS,
    FOCAL,
    NAME,
    PIXEL,
    POSE_CHOICE,
    STROKE_POINTS,
    STROKES,
    TOGETHER,
    sized,
    within,
)
from app.api.schemas.paging import DamagedOut, PageOut
from app.jobs.job import Job
from app.jobs.kinds.photos import sheet_name
from app.processes.messages.photo_messages import CameraSource, Mark, Points, Stroke
from app.storage.records import MarkedObject, TablePhoto
from osfcore.photo.found_scene import FoundLight, FoundPose, FoundScene, TableSource

Pixel = Annotated[FiniteFloat, Field(**within(PIXEL))]
PointIn = Annotated[list[Pixel], Field(min_length=2, max_length=2)]
Clicks = Annotated[list[PointIn], Field(**sized(CLICKS))]
Focal = Annotated[FiniteFloat, Field(**within(FOCAL), description="Focal length in pixels of the photo as sent.")]


class StrokeIn(Input):
    """A line of the brush."""

    adds: bool = Field(description="Whether what it covers belongs to the object; else it does not.")
    radius: float = Field(**within(BRUSH), allow_inf_nan=False, description="Of the brush [px].")
    points: Annotated[list[PointIn], Field(**sized(STROKE_POINTS))]


class MarkIn(Input):
    """How a person points at an object: a box around it, and as many clicks and strokes as it takes."""

    box: Annotated[list[Pixel], Field(min_length=4, max_length=4, description="Left, top, right, bottom [px].")]
    on: Clicks = Field(default=[], description="Clicks on the object.")
    off: Clicks = Field(default=[], description="Clicks beside it.")
    strokes: list[StrokeIn] = Field(default=[], **sized(STROKES))

    def mark(self) -> Mark:
        """Unchecked."""
        strokes = tuple(Stroke(each.adds, each.radius, _points(each.points)) for each in self.strokes)
        left, top, right, bottom = self.box
        return Mark((left, top, right, bottom), _points(self.on), _points(self.off), strokes)


class PhotoPatch(Input):
    """Another focal length; null for what board or file tell. A calibrated camera counts instead of it."""

    focal_px: Focal | None
    camera: CameraIn | None = Field(None, description="`camera` of a calibration.")


class FindIn(Input):
    """How to look for what is marked."""

    together: list[str] = Field(
        default=[], **sized(TOGETHER), description="Further photos of the same table; the board must be in view of all."
    )
    seed: Seed = 0


class ChoiceIn(Input):
    """Which of the poses of an object is right."""

    choice: int = Field(**within(POSE_CHOICE), description="Number in `poses`.")


class MakeTableIn(Input):
    """What to make a table of a photo with."""

    despite_doubts: bool = Field(False, description="Whether what was not found for certain counts all the same.")


class MakeGoalIn(MakeTableIn):
    """What to make a goal of a photo with."""

    scene: str | None = Field(
        None,
        **sized(NAME),
        description="That the goal is for; null for the one shown if it holds the photo's objects, else for a new one.",
    )


class PoseFound(FoundPose):
    """One of the poses that explain the photo."""

    picture: str | None = Field(
        description="Path of its sheet: photo, outlines of mask and object, object; may be null."
    )


class ObjectFound(BaseModel):
    """What was found of an object."""

    poses: list[PoseFound] = Field(description="The most likely first.")
    doubt: str = Field(description="Why it should not be trusted, a sentence; empty where it may be.")


class MarkedOut(BaseModel):
    """An object that was marked."""

    name: str
    label: str
    box: list[float]
    on: list[list[float]]
    off: list[list[float]]
    strokes: list[StrokeIn]
    outline: list[list[list[float]]] = Field(description="Closed polygons around its mask and around holes in it.")
    choice: int | None = Field(description="The pose that a person took; null before that.")
    found: ObjectFound | None

    @staticmethod
    def of(marked: MarkedObject, label: str, found: ObjectFound | None) -> MarkedOut:
        """From the service's own."""
        mark = marked.mark
        strokes = [StrokeIn(adds=s.adds, radius=s.radius, points=_lists(s.points)) for s in mark.strokes]
        return MarkedOut(
            name=marked.name, label=label, box=list(mark.box), on=_lists(mark.on), off=_lists(mark.off),
            strokes=strokes, outline=[_lists(line) for line in marked.outline], choice=marked.choice, found=found,
        )  # fmt: skip


class PhotoFacts(BaseModel):
    """A photo of a table."""

    id: str
    name: str
    created_at: str = Field(description="UTC, ISO 8601.")
    width: int = Field(description="[px]")
    height: int = Field(description="[px]")
    focal_px: float = Field(description="In pixels of the photo as it was sent.")
    focal_source: CameraSource = Field(description="Who tells it: the board, the user, the file, or nobody.")
    on_board: bool = Field(description="Whether the printed board is in view.")


class TablePhotoOut(PhotoFacts):
    """A photo of a table, with what is marked and what was found in it."""

    notes: list[str] = Field(description="Sentences about photo, camera, table and light.")
    objects: list[MarkedOut]
    job: JobOut | None = Field(description="The search for what is marked now; null if there was none.")
    table: TableSource | None = Field(description="What tells where the table is; null if nothing does, or not yet.")
    light: FoundLight | None = Field(description="In the frame of the poses.")
    doubts: list[str] = Field(description="Why nothing is made of it unless despite_doubts; empty where nothing is.")
    scene: str | None = Field(description="The table that it became.")

    @staticmethod
    def of(
        photo: TablePhoto, job: Job | None, found: FoundScene | None, doubts: Sequence[str], labels: dict[str, str]
    ) -> TablePhotoOut:
        """From the service's own."""
        each = {} if found is None or job is None else {o.name: _found(job, found, o.name) for o in found.objects}
        marked = [MarkedOut.of(one, labels.get(one.name, one.name), each.get(one.name)) for one in photo.objects]
        return TablePhotoOut(
            **facts_of(photo).model_dump(),
            notes=list(photo.notes) if found is None else found.notes,
            objects=marked,
            job=None if job is None else JobOut.of(job),
            table=None if found is None else found.table,
            light=None if found is None else found.light,
            doubts=list(doubts),
            scene=photo.scene,
        )


class PhotoList(PageOut):
    """Photos of tables, newest first."""

    photos: list[PhotoFacts]
    damaged: list[DamagedOut] = Field(description="What can only be deleted, on each page.")


class TableMadeOut(BaseModel):
    """A table that was made of a photo."""

    scene: SceneOut
    notes: list[str] = Field(description="Sentences about what does not lie as in the photo.")


class GoalMadeOut(TableMadeOut):
    """A goal that was made of a photo, and the table that it is for."""

    goal: GoalOut


def facts_of(photo: TablePhoto) -> PhotoFacts:
    """What a list tells of a photo."""
    return PhotoFacts(
        id=photo.id,
        name=photo.name,
        created_at=photo.created_at,
        width=photo.width,
        height=photo.height,
        focal_px=round(float(photo.K[0, 0]) * photo.sent_width / photo.width, 2),
        focal_source=photo.source,
        on_board=photo.T_world_camera is not None,
    )


def _found(job: Job, found: FoundScene, name: str) -> ObjectFound:
    one = next(each for each in found.objects if each.name == name)
    files = [sheet_name(name, number) for number in range(len(one.poses()))]
    poses = [
        PoseFound(**pose.model_dump(include=set(FoundPose.model_fields)), picture=_path(job, file))
        for pose, file in zip(one.poses(), files, strict=True)
    ]
    return ObjectFound(poses=poses, doubt=one.doubt)


def _path(job: Job, file: str) -> str | None:
    return f"/api/jobs/{job.id}/files/{file}" if file in job.files else None


def _points(points: list[list[float]]) -> Points:
    return tuple((x, y) for x, y in points)


def _lists(points: Points) -> list[list[float]]:
    return [[x, y] for x, y in points]
