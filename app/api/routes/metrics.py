"""What an operator watches."""

from typing import Any

from fastapi import APIRouter, Request, Response

from app.api.http_metrics import CONTENT_TYPE
from app.api.routes import problems

router = APIRouter(prefix="/api/metrics", tags=["metrics"], responses=problems())
_TEXT: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "The figures."}
}


@router.get("", response_class=Response, responses=_TEXT)
def get(request: Request) -> Response:
    """Tell scenes, jobs, request times and memory in the format of Prometheus."""
    return Response(request.app.state.metrics.text(), headers={"Content-Type": CONTENT_TYPE})
