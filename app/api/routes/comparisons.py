"""What the fields say the cameras see, beside what they saw."""

import uuid
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from app.api.dependencies import Services, ServicesDep
from app.api.routes import PNG, problems
from app.api.routes.scenes import CameraName, SceneId, SizeQuery, view_of
from app.processes.messages.neural_messages import CompareView, Comparison
from app.processes.messages.scene_messages import SceneRecord, TakeImage
from app.processes.render_cameras import scene_camera
from app.services.fields import MissingFields
from osfcore.errors import OsfError
from osfcore.geometry.states import SceneState

PSNR_HEADER = "X-PSNR-dB"
_PSNR: dict[str, object] = {
    "description": "Peak signal-to-noise ratio of the rendering against the camera's image [dB].",
    "schema": {"type": "number"},
}
COMPARED: dict[int | str, dict[str, object]] = {200: {**PNG[200], "headers": {PSNR_HEADER: _PSNR}}}
Kind = Annotated[
    Literal["rendered", "difference", "comparison"],
    Query(description="The difference is absolute, times 4; a comparison is camera image, rendering, difference."),
]
router = APIRouter(prefix="/api/scenes", tags=["neural"], responses=problems(503))


@router.get("/{scene}/neural/{camera}.png", response_class=Response, responses={**problems(404, 409), **COMPARED})
async def image(
    services: ServicesDep,
    scene: SceneId,
    camera: CameraName,
    kind: Kind = "rendered",
    size: SizeQuery = None,
    pusher: Annotated[bool, Query(description="Whether the pusher and its shadow are in the image.")] = True,
) -> Response:
    """Render what one camera sees from the objects' fields, where everything is now, and compare.

    The first time, this waits for the renderer to load.
    """
    side = size or view_of(services, scene, camera).image_size
    comparison = await _compare(services, TakeImage(scene, camera, side, pusher=pusher))
    return compared_png(comparison, kind)


def compared_png(comparison: Comparison, kind: str) -> Response:
    """One picture of a comparison, with its PSNR in the header."""
    headers = {"Cache-Control": "no-cache", PSNR_HEADER: f"{comparison.psnr_db:.2f}"}
    return Response(getattr(comparison, kind), media_type="image/png", headers=headers)


async def _compare(services: Services, command: TakeImage) -> Comparison:
    record, observed = await _observe(services, command)
    state = record.state
    known = services.fields.names()
    missing = [name for name in state.names if name not in known]
    if missing:
        raise MissingFields(missing)
    if not command.pusher:
        state = SceneState(state.names, state.poses, state.light, None)
    order = CompareView(uuid.uuid4().hex, state, scene_camera(command.camera, command.size), observed)
    return await compared(services, order)


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
    try:
        observed = await services.runner.image(command)
    except OsfError:
        view_of(services, command.id, command.camera)  # a scene that was deleted meanwhile is not found
        raise
    if tries > 1 and record.revision != view_of(services, command.id, command.camera).revision:
        return await _observe(services, command, tries - 1)
    return record, observed
