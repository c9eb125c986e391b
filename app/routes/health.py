"""Whether the service runs."""

from importlib.metadata import version

from fastapi import APIRouter

from app.routes import problems
from app.schemas import Health
from app.services import ServicesDep

router = APIRouter(prefix="/api", tags=["health"], responses=problems())
VERSION = version("osf-manipulation")


@router.get("/health")
async def get(services: ServicesDep) -> Health:
    """Tell that the service runs, and in which state."""
    return Health(
        status="ok",
        version=VERSION,
        uptime_s=round(services.runner.uptime_s, 3),
        objects_available=len(services.shelf.names()),
        stage=services.runner.stage_status,
    )
