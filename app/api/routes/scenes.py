"""Scenes: make, look at, change."""

from typing import Annotated

from fastapi import APIRouter, Path, Query, Response, status
from pydantic import BaseModel, Field

from app.api.bodies import BoundedRoute
from app.api.dependencies import Services, ServicesDep
from app.api.lanes import slow
from app.api.problems import NotFound, named_in_path
from app.api.routes import PNG, problems
from app.api.schemas.common import ActionsIn, ImageSize, Input, SceneIn, SceneList, SceneOut, ScenePatch
from app.api.schemas.paging import DEFAULT_PAGE, AfterEntry, Limit, page
from app.processes.messages.scene_messages import SceneRecord, TakeImage, TakeMask
from app.services.disturber import Kind
from osfcore.errors import OsfError, UnknownName
from osfcore.geometry.cameras import CAMERA_POSITIONS

router = APIRouter(prefix="/api/scenes", tags=["scenes"], responses=problems(503, 507), route_class=BoundedRoute)
_CAMERAS = (*(str(number) for number in range(len(CAMERA_POSITIONS))), "goal")
SceneId = Annotated[str, Path(description="Identifier of a scene.")]
CameraName = Annotated[str, Path(description='"0" to "3" or "goal".', examples=["0"])]
SizeQuery = Annotated[ImageSize | None, Query(description="Side of the image [px]; the scene's own if left out.")]


@router.post("", status_code=status.HTTP_201_CREATED, responses=problems(409))
@slow
def create(services: ServicesDep, body: SceneIn, response: Response) -> SceneOut:
    """Make a scene and show it; it has come to rest."""
    record = services.runner.create_scene(
        names=None if body.objects is None else tuple(body.objects),
        count=body.count,
        seed=body.seed,
        light=None if body.light is None else body.light.light(),
        poses=None if body.poses is None else tuple(pose.named_pose() for pose in body.poses),
        image_size=body.image_size,
    )
    response.headers["Location"] = f"/api/scenes/{record.id}"
    return services.scene_out(record)


@router.get("")
async def list_all(services: ServicesDep, limit: Limit = DEFAULT_PAGE, after: AfterEntry = None) -> SceneList:
    """List scenes, oldest first."""
    runner = services.runner
    shown, total, following = page(runner.scenes(), limit, after, newest_first=False)
    return SceneList(
        scenes=[services.scene_out(record) for record in shown], current=runner.current, total=total, next=following
    )


@router.get("/{scene}", responses=problems(404))
async def get(services: ServicesDep, scene: SceneId) -> SceneOut:
    """Tell how a scene is now."""
    return services.scene_out(record_of(services, scene))


@router.delete("/{scene}", status_code=status.HTTP_204_NO_CONTENT, responses=problems(404, 409))
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
    return services.scene_out(services.runner.activate(scene))


@router.post("/{scene}/reset", responses=problems(404, 409))
@slow
def reset(services: ServicesDep, scene: SceneId) -> SceneOut:
    """Put a scene back to how it was created."""
    record_of(services, scene)
    return services.scene_out(services.runner.reset_scene(scene))


@router.patch("/{scene}", responses=problems(404, 409))
@slow
def change(services: ServicesDep, scene: SceneId, body: ScenePatch) -> SceneOut:
    """Move light and objects by hand, all or nothing."""
    record_of(services, scene)
    record = services.runner.edit_scene(
        scene,
        light=None if body.light is None else body.light.light(),
        poses=tuple(pose.named_pose() for pose in body.objects or ()),
    )
    return services.scene_out(record)


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
    return DisturbanceOut(text=text, scene=services.scene_out(record))


@router.post("/{scene}/actions", responses=problems(404, 409))
@slow
def act(services: ServicesDep, scene: SceneId, body: ActionsIn) -> SceneOut:
    """Push: hold each velocity for 0.2 s of simulated time."""
    record_of(services, scene)
    return services.scene_out(services.runner.act(scene, body.actions))


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
    try:
        png = await services.runner.image(command)
    except OsfError:
        record_of(services, command.id)  # a scene that was deleted meanwhile is not found, whatever the simulation says
        raise
    return Response(png, media_type="image/png", headers={"Cache-Control": "no-cache"})


def record_of(services: Services, scene: str) -> SceneRecord:
    """A scene that a path names.

    Raises:
        NotFound: if there is none.
    """
    with named_in_path():
        return services.runner.scene(scene)


def view_of(services: Services, scene: str, camera: str) -> SceneRecord:
    """The scene of a path that names a camera, too.

    Raises:
        NotFound: if there is no such scene or camera.
    """
    record = record_of(services, scene)
    if camera not in _CAMERAS:
        raise NotFound(str(UnknownName("camera", camera, _CAMERAS)))
    return record
