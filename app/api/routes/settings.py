"""What can be set about episodes."""

from fastapi import APIRouter

from app.api.routes import problems
from app.api.schemas.episodes import ServiceSettings

router = APIRouter(prefix="/api/settings", tags=["settings"], responses=problems())


@router.get("")
async def get() -> ServiceSettings:
    """Tell defaults and bounds of an episode's settings."""
    return ServiceSettings.now()
