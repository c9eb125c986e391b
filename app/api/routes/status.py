"""Whether the service runs, what an operator watches, and what can be set."""

from importlib.metadata import version
from typing import Any

from fastapi import APIRouter, Request, Response

from app.api.condition import problems as problems_of
from app.api.dependencies import ServicesDep
from app.api.http_metrics import CONTENT_TYPE
from app.api.lanes import urgent
from app.api.routes import problems
from app.api.schemas.common import Health
from app.api.schemas.episodes import ServiceSettings

router = APIRouter(prefix="/api", responses=problems())
VERSION = version("osf-manipulation")
_TEXT: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "The figures."}
}


@router.get("/health", tags=["health"])
@urgent
def health(services: ServicesDep) -> Health:
    """Tell that the service runs, and what is wrong with it."""
    found = list(problems_of(services.runner, services.settings.data_dir))
    return Health(
        status="degraded" if found else "ok",
        problems=found,
        version=VERSION,
        uptime_s=round(services.runner.uptime_s, 3),
        objects_available=len(services.objects.names()),
        stage=services.runner.simulation_status,
    )


@router.get("/metrics", tags=["metrics"], response_class=Response, responses=_TEXT)
def metrics(request: Request) -> Response:
    """Tell scenes, jobs, request times and memory in the format of Prometheus."""
    return Response(request.app.state.metrics.text(), headers={"Content-Type": CONTENT_TYPE})


@router.get("/settings", tags=["settings"])
async def settings() -> ServiceSettings:
    """Tell defaults and bounds of an episode's settings."""
    return ServiceSettings.now()
