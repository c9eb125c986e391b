"""The app factory: REST under /api, events, the viewer's relay at /viewer, documentation, and the page at /."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

from fastapi import Depends, FastAPI, Request
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.openapi.utils import get_openapi
from fastapi.responses import HTMLResponse
from fastapi.routing import APIRoute
from fastapi.staticfiles import StaticFiles
from starlette.concurrency import run_in_threadpool

from ..services.service_settings import Settings
from ..storage.paths import static_folder
from . import (
    episodes,
    estimates,
    events,
    fields,
    goals,
    jobs,
    objects,
    page,
    photos,
    predictions,
    problems,
    relay,
    robot,
    scenes,
    status,
)
from .bodies import SMALL_BODY_BYTES, CompressionMiddleware, HeadMiddleware
from .dependencies import Services, only_the_driver
from .guards.connection_timeouts import BodyTimeoutMiddleware
from .guards.security import BodyLimitMiddleware, SecurityMiddleware
from .guards.token_gate import COOKIE, OPEN, TokenMiddleware

_DESCRIPTION = (
    "Scenes of real objects on a lit table, a pusher to move them, cameras to look at them, estimates of what they "
    "see, predictions of what pushes do, and jobs for long work. "
    "Metres, seconds, quaternions (w, x, y, z); world z up, table top at z = 0. "
    "Errors are application/problem+json with one sentence in `detail`."
)

_ROUTERS = (
    status.router, status.storage_router, objects.router, fields.router, scenes.router, scenes.neural_router,
    page.presets_router, page.stories_router, goals.router, photos.router, photos.pictures_router,
    photos.calibration_router, episodes.router,
    estimates.router, predictions.router, predictions.push_router, jobs.router, events.router,
)  # fmt: skip
_OPEN_ROUTERS = (page.driver_router, page.views_router, robot.router, relay.router)  # of one page, or for anybody
_OTHER_MODELS = (
    problems.Problem, events.ForgottenEvent, events.FrameEvent, events.LookEvent, events.NoticeEvent,
    estimates.EstimateIn, goals.GoalIn,
)  # fmt: skip
_STREAM = "text/event-stream"
_SECURITY = {
    "token": {"type": "http", "scheme": "bearer", "description": "OSF_TOKEN, where the service has one."},
    "session": {"type": "apiKey", "in": "cookie", "name": COOKIE, "description": "What /?token=TOKEN sets."},
}
_TAGS = {
    "health": "Whether the service runs.", "metrics": "Figures for Prometheus.", "settings": "What can be set.",
    "storage": "What the data directory holds.", "objects": "Things that lie on tables.",
    "fields": "Neural fields of objects, and image sets to train them from.", "scenes": "Tables that are simulated.",
    "neural": "What the fields say the cameras see.", "presets": "Tables to begin with, each with a goal.",
    "stories": "Recorded episodes that come with the program.", "goals": "Images of how a table should look.",
    "photos": "Photographs of tables, and of the board that calibrates a camera.",
    "episodes": "From a table to its goal, push by push.", "estimates": "Poses and light from images.",
    "predictions": "What pushes would do.", "jobs": "Long work.", "events": "What happens, as it happens.",
    "driver": "Which page has the controls.", "views": "What the 3D view of a page shows.", "robot": "A real arm.",
}  # fmt: skip


def create_app(settings: Settings | None = None) -> FastAPI:
    """The service as an ASGI app; everything starts and stops with its lifespan."""
    settings = settings or Settings()
    app = FastAPI(
        title="OSF manipulation",
        version=status.VERSION,
        description=_DESCRIPTION,
        openapi_url="/api/openapi.json",
        docs_url=None,  # the default pages load scripts from elsewhere
        redoc_url=None,
        lifespan=_lifespan,
        generate_unique_id_function=_operation_id,
    )
    app.state.settings, app.state.metrics = settings, status.Metrics()
    app.add_middleware(events.DepartureMiddleware)
    app.add_middleware(CompressionMiddleware)
    app.add_middleware(HeadMiddleware)
    app.add_middleware(BodyTimeoutMiddleware)
    app.add_middleware(BodyLimitMiddleware, limit_of=partial(_body_limit, settings))
    if settings.token is not None:
        app.add_middleware(TokenMiddleware, token=settings.token.get_secret_value())
    app.add_middleware(  # outside of the limit and the token, whose refusals get its headers, too
        SecurityMiddleware, allowed_hosts=settings.allowed_hosts, allowed_origins=settings.allowed_origins
    )
    app.add_middleware(status.MetricsMiddleware, metrics=app.state.metrics)
    problems.install(app)
    for router in _ROUTERS:
        app.include_router(router, dependencies=[Depends(only_the_driver)])
    for router in _OPEN_ROUTERS:
        app.include_router(router)
    _add_docs(app)
    app.state.routes = [route for router in (*_ROUTERS, *_OPEN_ROUTERS, app) for route in router.routes]
    app.openapi = lambda: _openapi(app)  # pyright: ignore[reportAttributeAccessIssue]
    app.mount("/", StaticFiles(directory=static_folder(), html=True), name="static")
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    services = Services(app.state.settings)
    try:
        await run_in_threadpool(services.start)
        app.state.services = services
        app.state.metrics.watch(services.runner)
        yield
    finally:
        await run_in_threadpool(services.stop)


def _body_limit(settings: Settings, path: str) -> int:
    """How large a request to a path may be [bytes]: only uploads and many sequences of actions are large."""
    path = path.rstrip("/")
    if path in (goals.UPLOAD_PATH, photos.UPLOAD_PATH, photos.PICTURES_UPLOAD_PATH, photos.CALIBRATION_UPLOAD_PATH):
        return max(settings.max_photo_bytes, settings.max_body_bytes)
    if path in (objects.UPLOAD_PATH, fields.UPLOAD_PATH, estimates.UPLOAD_PATH):
        return settings.max_upload_bytes
    is_large = path == predictions.router.prefix
    return settings.max_body_bytes if is_large else min(SMALL_BODY_BYTES, settings.max_body_bytes)


def _operation_id(route: APIRoute) -> str:
    return f"{route.tags[0]}-{route.name}" if route.tags else route.name


def _openapi(app: FastAPI) -> dict[str, Any]:
    """The schema with those models that no route returns as such: problems and the events' data."""
    if app.openapi_schema is None:
        schema = get_openapi(
            title=app.title,
            version=app.version,
            description=app.description,
            routes=app.routes,
            tags=[{"name": name, "description": text} for name, text in _TAGS.items()],
            license_info={"name": "MIT", "identifier": "MIT"},
            servers=[{"url": "/"}],
        )
        schema["security"] = [{}, *({name: []} for name in _SECURITY)]
        schema["components"]["securitySchemes"] = _SECURITY
        schemas = schema["components"]["schemas"]
        for model in _OTHER_MODELS:
            own = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= own.pop("$defs", {})
            schemas[model.__name__] = own
        for path in (operations["get"] for operations in schema["paths"].values() if "get" in operations):
            content = path["responses"]["200"].get("content", {})
            if _STREAM in content:  # FastAPI describes it in terms of OpenAPI 3.2, which readers of 3.1 refuse
                content[_STREAM] = {"schema": {"type": "string"}}
        for path in OPEN:
            schema["paths"][path]["get"]["security"] = []
            del schema["paths"][path]["get"]["responses"]["401"]
        app.openapi_schema = schema
    return app.openapi_schema


def _add_docs(app: FastAPI) -> None:
    """Swagger UI with the scripts that lie beside those of the page."""

    @app.get("/docs", include_in_schema=False)
    async def docs(request: Request) -> HTMLResponse:
        """The interactive documentation."""
        base = request.scope.get("root_path", "")
        return get_swagger_ui_html(
            openapi_url=f"{base}/api/openapi.json",
            title="OSF manipulation: REST interface",
            swagger_js_url=f"{base}/vendor/swagger-ui-5.35.0.js",
            swagger_css_url=f"{base}/vendor/swagger-ui-5.35.0.css",
            swagger_favicon_url=f"{base}/icon.svg",
        )
