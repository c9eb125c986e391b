"""Scenes: make, look at, change, and compare with what the objects' fields say of them."""

from __future__ import annotations

import uuid
from dataclasses import replace
from functools import cache
from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query, Response
from pydantic import BaseModel, Field

from osfcore.errors import OsfError, UnknownName
from osfcore.geometry.cameras import CAMERA_POSITIONS, DEFAULT_IMAGE_SIDE, default_cameras, goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.io.scene_file import CameraJson, ObjectJson, PointJson
from osfcore.world.simulators import Simulator

from ..jobs.params import ImageSize, ObjectCount, Seed
from ..processes.messages.neural_messages import CompareView, Comparison
from ..processes.messages.scene_messages import SceneRecord, TakeImage, TakeMask
from ..processes.render_cameras import scene_camera
from ..services.disturber import Kind
from ..services.fields import MissingFields
from .bodies import PNG, BoundedRoute
from .dependencies import Services, ServicesDep, slow
from .models import Input, LightIn, ObjectNames, ObjectPose, Poses, Velocity
from .paging import DEFAULT_PAGE, AfterEntry, Limit, PageOut, page
from .problems import NotFound, named_in_path, problems


class SceneIn(Input):
    """What a new scene shall contain; everything left out is drawn from the seed."""

    objects: ObjectNames | None = Field(None, description="Which objects.")
    count: ObjectCount = Field(3, description="How many objects, where they are not named.")
    seed: Seed | None = Field(None, description="The same seed gives the same scene; null for any.")
    light: LightIn | None = None
    poses: Poses | None = Field(None, description="Exact poses, instead of random resting ones.")
    image_size: ImageSize = DEFAULT_IMAGE_SIDE


class ScenePatch(Input):
    """What to move by hand, all or nothing."""

    light: LightIn | None = None
    objects: list[ObjectPose] | None = Field(None, max_length=MAX_OBJECTS)


class ActionsIn(Input):
    """Velocities of the pusher, one after the other."""

    actions: list[Velocity] = Field(min_length=1, max_length=50, examples=[[[0.2, 0.0, 0.0]]])


class SceneObject(ObjectJson):
    """An object on the table."""

    label: str

    @staticmethod
    def labelled(name: str, pose: Pose, labels: dict[str, str]) -> SceneObject:
        """An object with its label.

        Args:
            name: of the object.
            pose: T_world_object [m].
            labels: by name; an object without one is called by its name.
        """
        return SceneObject(**dict(ObjectJson.of(name, pose)), label=labels.get(name, name))


class SceneOut(BaseModel):
    """A scene as it is now."""

    id: str
    seed: int
    created_at: str = Field(description="UTC, ISO 8601.")
    is_current: bool = Field(description="Whether it is the one that viewer and page show.")
    time_s: float = Field(description="Simulated time since creation or reset [s].")
    objects: list[SceneObject]
    light: PointJson
    pusher: PointJson | None = Field(description="Centre of the pusher.")
    cameras: list[CameraJson]
    image_size: int = Field(description="[px]")
    revision: int = Field(description="Grows with every change.")
    simulator: Simulator = Field(description="What moves the objects.")

    @staticmethod
    def of(record: SceneRecord, labels: dict[str, str], simulator: Simulator, *, is_current: bool) -> SceneOut:
        """From the simulation's record.

        Args:
            record: of the scene.
            labels: of objects, by name.
            simulator: what moves them.
            is_current: whether viewer and page show this scene.
        """
        state = record.state
        return SceneOut(
            id=record.id,
            seed=record.seed,
            created_at=record.created_at,
            is_current=is_current,
            time_s=round(record.time_s, 6),
            objects=[SceneObject.labelled(name, state.pose(name), labels) for name in state.names],
            light=PointJson.of(state.light.position),
            pusher=None if state.pusher is None else PointJson.of(state.pusher),
            cameras=_cameras(record.image_size),
            image_size=record.image_size,
            revision=record.revision,
            simulator=simulator,
        )


@cache  # every answer about a scene lists its cameras
def _cameras(size: int) -> list[CameraJson]:
    return [CameraJson.of(camera) for camera in (*default_cameras(size), goal_camera(size))]


class SceneList(PageOut):
    """All scenes, oldest first."""

    scenes: list[SceneOut]
    current: str | None = Field(description="Identifier of the scene that is shown.")


router = APIRouter(prefix="/api/scenes", tags=["scenes"], responses=problems(503, 507), route_class=BoundedRoute)
_CAMERAS = (*(str(number) for number in range(len(CAMERA_POSITIONS))), "goal")
SceneId = Annotated[str, Path(description="Identifier of a scene.")]
CameraName = Annotated[str, Path(description='"0" to "3" or "goal".', examples=["0"])]
SizeQuery = Annotated[ImageSize | None, Query(description="Side of the image [px]; the scene's own if left out.")]


@router.post("", status_code=201, responses=problems(409))
@slow
def create(services: ServicesDep, body: SceneIn, response: Response) -> SceneOut:
    """Make a scene and show it; it has come to rest."""
    record = services.runner.scenes.create(
        names=None if body.objects is None else tuple(body.objects),
        count=body.count,
        seed=body.seed,
        light=None if body.light is None else body.light.light(),
        poses=None if body.poses is None else tuple(pose.named_pose() for pose in body.poses),
        image_size=body.image_size,
    )
    response.headers["Location"] = f"/api/scenes/{record.id}"
    return scene_out(services, record)


@router.get("")
async def list_all(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterEntry = None) -> SceneList:
    """List scenes, oldest first."""
    runner = services.runner
    shown, total, following = page(runner.scenes.all(), limit, after, newest_first=False)
    return SceneList(
        scenes=[scene_out(services, record) for record in shown],
        current=runner.scenes.current,
        total=total,
        next=following,
    )


@router.get("/{scene}", responses=problems(404))
async def get(services: ServicesDep, scene: SceneId) -> SceneOut:
    """Return how a scene is now."""
    return scene_out(services, record_of(services, scene))


@router.delete("/{scene}", status_code=204, responses=problems(404, 409))
@slow
def delete(services: ServicesDep, scene: SceneId) -> None:
    """Forget a scene."""
    record_of(services, scene)
    services.runner.delete_scene(scene)


@router.post("/{scene}/activate", responses=problems(404))
@slow
def activate(services: ServicesDep, scene: SceneId) -> SceneOut:
    """Show a scene in viewer and page."""
    record_of(services, scene)
    return scene_out(services, services.runner.scenes.activate(scene))


@router.post("/{scene}/reset", responses=problems(404, 409))
@slow
def reset(services: ServicesDep, scene: SceneId) -> SceneOut:
    """Put a scene back to how it was created."""
    record_of(services, scene)
    return scene_out(services, services.runner.scenes.reset(scene))


@router.patch("/{scene}", responses=problems(404, 409))
@slow
def change(services: ServicesDep, scene: SceneId, body: ScenePatch) -> SceneOut:
    """Move light and objects by hand, all or nothing."""
    record_of(services, scene)
    record = services.runner.scenes.edit(
        scene,
        light=None if body.light is None else body.light.light(),
        poses=tuple(pose.named_pose() for pose in body.objects or ()),
    )
    return scene_out(services, record)


class DisturbanceIn(Input):
    """What to do to a scene behind the program's back."""

    kind: Kind = Field(description="Dimming and covering are undone by asking once more.")


class DisturbanceOut(BaseModel):
    """What was done."""

    text: str
    scene: SceneOut


@router.post("/{scene}/disturbances", responses=problems(404, 409, 503))
@slow
def disturb(services: ServicesDep, scene: SceneId, body: DisturbanceIn) -> DisturbanceOut:
    """Try to fool an episode while it runs: turn the lamp, dim the light, nudge an object, cover a camera."""
    record_of(services, scene)
    record, text = services.disturber.disturb(scene, body.kind)
    return DisturbanceOut(text=text, scene=scene_out(services, record))


@router.post("/{scene}/actions", responses=problems(404, 409))
@slow
def act(services: ServicesDep, scene: SceneId, body: ActionsIn) -> SceneOut:
    """Push: hold each velocity for 0.2 s of simulated time."""
    record_of(services, scene)
    return scene_out(services, services.runner.scenes.act(scene, body.actions))


@router.get("/{scene}/images/{camera}.png", response_class=Response, responses={**problems(404), **PNG})
async def image(
    services: ServicesDep,
    scene: SceneId,
    camera: CameraName,
    size: SizeQuery = None,
    masks: Annotated[bool, Query(description="Draw each object's visible pixels over it, in colour.")] = False,
    pusher: Annotated[bool, Query(description="Whether the pusher and its shadow are in the image.")] = True,
) -> Response:
    """Take an image with one camera."""
    record = view_of(services, scene, camera)
    return await _png(services, TakeImage(scene, camera, size or record.image_size, masks, pusher))


@router.get("/{scene}/masks/{camera}/{name}.png", response_class=Response, responses={**problems(404), **PNG})
async def mask(
    services: ServicesDep,
    scene: SceneId,
    camera: CameraName,
    name: Annotated[str, Path(description="Name of an object of the scene.")],
    size: SizeQuery = None,
) -> Response:
    """Take the visible pixels of one object: 255 where it is seen, else 0."""
    record = view_of(services, scene, camera)
    if name not in record.state.names:
        raise NotFound(str(UnknownName("object on the table", name, record.state.names)))
    return await _png(services, TakeMask(scene, camera, name, size or record.image_size))


async def _png(services: Services, command: TakeImage | TakeMask) -> Response:
    return Response(await _taken(services, command), media_type="image/png", headers={"Cache-Control": "no-cache"})


async def _taken(services: Services, command: TakeImage | TakeMask) -> bytes:
    try:
        return await services.runner.scenes.image(command)
    except OsfError:
        record_of(services, command.id)  # a scene that was deleted meanwhile is not found, whatever the simulation says
        raise


def scene_out(services: Services, record: SceneRecord) -> SceneOut:
    """A scene as it is answered."""
    scenes = services.runner.scenes
    return SceneOut.of(record, services.objects.labels(), scenes.simulator, is_current=record.id == scenes.current)


def record_of(services: Services, scene: str) -> SceneRecord:
    """A scene that a path names.

    Raises:
        NotFound: if there is none.
    """
    with named_in_path():
        return services.runner.scenes.get(scene)


def view_of(services: Services, scene: str, camera: str) -> SceneRecord:
    """The scene of a path that names a camera, too.

    Raises:
        NotFound: if there is no such scene or camera.
    """
    record = record_of(services, scene)
    if camera not in _CAMERAS:
        raise NotFound(str(UnknownName("camera", camera, _CAMERAS)))
    return record


PSNR_HEADER = "X-PSNR-dB"
_PSNR: dict[str, object] = {
    "description": "Peak signal-to-noise ratio of the rendering against the camera's image [dB].",
    "schema": {"type": "number"},
}
COMPARED: dict[int | str, dict[str, object]] = {200: {**PNG[200], "headers": {PSNR_HEADER: _PSNR}}}
neural_router = APIRouter(prefix="/api/scenes", tags=["neural"], responses=problems(503))


@neural_router.get(
    "/{scene}/neural/{camera}.png", name="image", response_class=Response, responses={**problems(404, 409), **COMPARED}
)
async def neural_image(
    services: ServicesDep,
    scene: SceneId,
    camera: CameraName,
    kind: Annotated[
        Literal["rendered", "difference", "comparison"],
        Query(description="The difference is absolute, times 4; a comparison is camera image, rendering, difference."),
    ] = "rendered",
    size: SizeQuery = None,
    pusher: Annotated[bool, Query(description="Whether the pusher and its shadow are in the image.")] = True,
) -> Response:
    """Render what one camera sees from the objects' fields, where everything is now, and compare.

    The first time, this waits for the renderer to load.
    """
    side = size or view_of(services, scene, camera).image_size
    record, observed = await _observe(services, TakeImage(scene, camera, side, pusher=pusher))
    state, known = record.state, services.fields.names()
    missing = [name for name in state.names if name not in known]
    if missing:
        raise MissingFields(missing)
    if not pusher:
        state = replace(state, pusher=None)
    order = CompareView(uuid.uuid4().hex, state, scene_camera(camera, side), observed)
    return compared_png(await compared(services, order), kind)


def compared_png(comparison: Comparison, kind: str) -> Response:
    """One picture of a comparison, with its PSNR in the header."""
    headers = {"Cache-Control": "no-cache", PSNR_HEADER: f"{comparison.psnr_db:.2f}"}
    return Response(getattr(comparison, kind), media_type="image/png", headers=headers)


async def compared(services: Services, order: CompareView) -> Comparison:
    """What answers an order.

    Raises:
        OsfError: if the renderer refuses it or is not there now.
    """
    answer = await services.neural.call_async(order)
    assert isinstance(answer, Comparison)
    return answer


async def _observe(services: Services, command: TakeImage, tries: int = 3) -> tuple[SceneRecord, bytes]:
    """A camera's image, and the scene as it was then; while things keep moving, one that is close."""
    record = view_of(services, command.id, command.camera)
    observed = await _taken(services, command)
    if tries > 1 and record.revision != view_of(services, command.id, command.camera).revision:
        return await _observe(services, command, tries - 1)
    return record, observed
