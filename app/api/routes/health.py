"""Whether the service runs."""

from importlib.metadata import version

from fastapi import APIRouter

from app.api.dependencies import ServicesDep
from app.api.routes import problems
from app.api.schemas.common import Health

router = APIRouter(prefix="/api", tags=["health"], responses=problems())
VERSION = version("osf-manipulation")


@router.get("/health")
async def get(services: ServicesDep) -> Health:
    """Tell that the service runs, and in which state."""
    return Health(
        status="ok",
        version=VERSION,
        uptime_s=round(services.runner.uptime_s, 3),
        objects_available=len(services.objects.names()),
        stage=services.runner.simulation_status,
    )
