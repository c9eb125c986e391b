"""Tables to begin with, each with a goal."""

from fastapi import APIRouter, Path, status
from pydantic import BaseModel, Field

from app.api.bodies import BoundedRoute
from app.api.dependencies import ServicesDep
from app.api.lanes import slow
from app.api.problems import named_in_path
from app.api.routes import problems
from app.api.schemas.common import SceneOut
from app.api.schemas.goals import GoalOut
from app.services.examples.presets import PRESETS, preset, set_up
from app.storage.paths import static_folder

router = APIRouter(prefix="/api/presets", tags=["presets"], responses=problems(), route_class=BoundedRoute)


class PresetOut(BaseModel):
    """A table and its goal."""

    id: str
    title: str
    text: str
    objects: int
    missing: list[str] = Field(description="Objects that are not on this machine or have no field yet.")
    image: str | None = Field(description="Path of a picture, below the page's own.")


class PresetList(BaseModel):
    """All of them, easiest first."""

    presets: list[PresetOut]


class PresetMade(BaseModel):
    """What a preset has made."""

    scene: SceneOut
    goal: GoalOut


@router.get("")
def list_all(services: ServicesDep) -> PresetList:
    """List tables to begin with."""
    usable = set(services.objects.names()) & set(services.fields.names())
    return PresetList(
        presets=[
            PresetOut(
                id=one.id,
                title=one.title,
                text=one.text,
                objects=len(one.objects),
                missing=[name for name in one.objects if name not in usable],
                image=_image(one.id),
            )
            for one in PRESETS
        ]
    )


@router.post("/{preset_id}", status_code=status.HTTP_201_CREATED, responses=problems(404, 409, 503, 507))
@slow
def make(services: ServicesDep, preset_id: str = Path(description="Identifier of a preset.")) -> PresetMade:
    """Make a preset's scene, which is then shown, and its goal image."""
    with named_in_path():
        chosen = preset(preset_id)
    scene, goal = set_up(chosen, services.runner, services.goals)
    return PresetMade(scene=services.scene_out(scene), goal=GoalOut.of(goal))


def _image(name: str) -> str | None:
    path = f"presets/{name}.webp"
    return path if (static_folder() / path).is_file() else None
