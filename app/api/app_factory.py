"""The app factory: REST under /api, events, the viewer's relay at /viewer, documentation, and the page at /."""

from __future__ import annotations

import importlib.util
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import Depends, FastAPI, Request
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.openapi.utils import get_openapi
from fastapi.responses import HTMLResponse
from fastapi.routing import APIRoute
from fastapi.staticfiles import StaticFiles
from starlette.concurrency import run_in_threadpool

from app.api import problems, relay
from app.api.bodies import SMALL_BODY_BYTES
from app.api.dependencies import ObjectCatalogue, Services, only_the_driver
from app.api.guards.connection_timeouts import BodyTimeoutMiddleware
from app.api.guards.security import BodyLimitMiddleware, SecurityMiddleware
from app.api.guards.token_gate import TokenMiddleware
from app.api.http_metrics import Metrics, MetricsMiddleware
from app.api.routes import (
    calibration,
    episodes,
    estimates,
    events,
    fields,
    goals,
    jobs,
    objects,
    photos,
    predictions,
    scenes,
    status,
    storage,
)
from app.api.routes import comparisons as neural
from app.api.routes.pages import driver, presets, robot, stories, views
from app.api.schemas.common import ForgottenEvent, FrameEvent, LookEvent, NoticeEvent, Problem
from app.api.schemas.estimates import EstimateIn
from app.api.schemas.goals import GoalIn
from app.processes.predict_process import predictor_main
from app.processes.process_client import ProcessClient
from app.processes.render_process import renderer_main
from app.services.disturber import Disturber
from app.services.episodes import Episodes
from app.services.estimates import Estimates
from app.services.examples.presets import OPENING, preset
from app.services.fields import FieldCatalogue
from app.services.goals.goal_checks import GoalChecks
from app.services.goals.goals import Goals
from app.services.objects.own_objects import OwnObjects
from app.services.objects.thumbnails import Thumbnails
from app.services.photos.board_photos import BoardPhotos
from app.services.photos.photo_tables import PhotoTables
from app.services.photos.table_photos import TablePhotos
from app.services.predictions import Predictions
from app.services.robots.robot_table import RobotTable
from app.services.runner import DemoScene, Runner
from app.services.service_settings import Settings
from app.services.visitors.driver import GRACE_S, Driver
from app.services.visitors.look_outlines import Outliner
from app.storage.database import Store
from app.storage.paths import static_folder
from app.storage.photos import PhotoReader
from app.viewer import Viewer
from osfcore.objects.asset_library import AssetLibrary

_DESCRIPTION = (
    "Scenes of real objects on a lit table, a pusher to move them, cameras to look at them, estimates of what they "
    "see, predictions of what pushes do, and jobs for long work. "
    "Metres, seconds, quaternions (w, x, y, z); world z up, table top at z = 0. "
    "Errors are application/problem+json with one sentence in `detail`."
)

_ROUTES = (
    status, objects, fields, scenes, presets, goals, photos, calibration, episodes, neural, estimates, predictions,
    jobs, robot, driver, views, stories, storage, events,
)  # fmt: skip
_UPLOAD_PATHS = (objects.UPLOAD_PATH, fields.UPLOAD_PATH, estimates.UPLOAD_PATH)
_STREAM = "text/event-stream"


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
    app.state.settings, app.state.metrics = settings, Metrics()
    limit_of = partial(_body_limit, settings)
    app.add_middleware(BodyTimeoutMiddleware)
    app.add_middleware(BodyLimitMiddleware, limit_of=limit_of)
    if settings.token is not None:
        app.add_middleware(TokenMiddleware, token=settings.token.get_secret_value())
    app.add_middleware(  # outermost: also the limit's answer gets its headers and becomes a problem
        SecurityMiddleware,
        allowed_hosts=settings.allowed_hosts,
        allowed_origins=settings.allowed_origins,
        limit_of=limit_of,
    )
    app.add_middleware(MetricsMiddleware, metrics=app.state.metrics)
    problems.install(app)
    for module in _ROUTES:
        watching = module in (driver, views, robot)  # what concerns one page alone, and a stop, which anybody may call
        app.include_router(module.router, dependencies=[] if watching else [Depends(only_the_driver)])
    app.include_router(relay.router)
    _add_docs(app)
    app.openapi = lambda: _openapi(app)  # pyright: ignore[reportAttributeAccessIssue]
    app.mount("/", StaticFiles(directory=static_folder(), html=True), name="static")
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    settings: Settings = app.state.settings
    async with AsyncExitStack() as stack:
        store = await run_in_threadpool(Store, settings.data_dir, settings.max_stored_events)
        stack.push_async_callback(run_in_threadpool, store.close)
        opening = preset(OPENING)
        demo = DemoScene(opening.objects, opening.seed, opening.light)
        runner = Runner(settings, store, AssetLibrary(settings.data_dir / "objects"), demo)
        stack.push_async_callback(run_in_threadpool, runner.stop)
        await run_in_threadpool(runner.start)
        neural = ProcessClient(renderer_main, (settings.data_dir,), "neural renderer")
        stack.push_async_callback(run_in_threadpool, neural.stop)
        objects = ObjectCatalogue(runner.library)
        fields = FieldCatalogue(settings.data_dir, objects.names)
        estimate_service = Estimates(runner, fields)
        stack.push_async_callback(run_in_threadpool, estimate_service.stop)
        predictor = ProcessClient(predictor_main, (settings.data_dir,), "predictor of pushes")
        stack.push_async_callback(run_in_threadpool, predictor.stop)
        prediction_service = Predictions(runner, fields.names, predictor)
        reader = PhotoReader()
        stack.push_async_callback(run_in_threadpool, reader.stop)
        goal_service = Goals(runner, settings.data_dir, settings.max_goals, reader)
        await run_in_threadpool(goal_service.start)
        checks = GoalChecks(runner, fields, goal_service, neural, objects.labels)
        table_photos = TablePhotos(runner, fields, settings.data_dir, settings.max_photos)
        stack.push_async_callback(run_in_threadpool, table_photos.stop)
        await run_in_threadpool(table_photos.start)
        photo_tables = PhotoTables(runner, table_photos, goal_service, neural)
        viewer = Viewer(runner, neural, fields.names, prediction_service, goal_service)
        stack.push_async_callback(run_in_threadpool, viewer.stop)
        await run_in_threadpool(viewer.start)
        thumbnails = Thumbnails(runner.library, settings.data_dir / "thumbnails")
        stack.push_async_callback(run_in_threadpool, thumbnails.stop)
        robot_table = RobotTable(settings, runner, fields, goal_service)
        stack.push_async_callback(run_in_threadpool, robot_table.close)
        await run_in_threadpool(robot_table.start)
        services = Services(
            settings, store, runner, viewer, objects, fields, neural, estimate_service, prediction_service,
            goal_service, checks, table_photos, photo_tables, BoardPhotos(table_photos.looker.ask),
            Episodes(runner, fields, goal_service, checks), Driver(runner.hub.publish, GRACE_S), OwnObjects(runner),
            thumbnails, Outliner(runner.library), Disturber(runner, np.random.default_rng()), robot_table,
        )  # fmt: skip
        app.state.services = services
        app.state.metrics.watch(runner)
        stack.callback(services.lanes.close)
        stack.callback(services.closing.set)
        yield


def _body_limit(settings: Settings, path: str) -> int:
    """How large a request to a path may be [bytes]: only uploads and many sequences of actions are large."""
    path = path.rstrip("/")
    if path in (goals.UPLOAD_PATH, photos.UPLOAD_PATH, calibration.UPLOAD_PATH):
        return max(settings.max_photo_bytes, settings.max_body_bytes)
    if path in _UPLOAD_PATHS:
        return settings.max_upload_bytes
    is_large = path == predictions.router.prefix
    return settings.max_body_bytes if is_large else min(SMALL_BODY_BYTES, settings.max_body_bytes)


def _operation_id(route: APIRoute) -> str:
    return f"{route.tags[0]}-{route.name}" if route.tags else route.name


def _openapi(app: FastAPI) -> dict[str, Any]:
    """The schema with those models that no route returns as such: problems and the events' data."""
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        schemas = schema.setdefault("components", {}).setdefault("schemas", {})
        for model in (Problem, ForgottenEvent, FrameEvent, LookEvent, NoticeEvent, EstimateIn, GoalIn):
            own = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= own.pop("$defs", {})
            schemas[model.__name__] = own
        for path in (operations["get"] for operations in schema["paths"].values() if "get" in operations):
            content = path["responses"]["200"].get("content", {})
            if _STREAM in content:  # FastAPI describes it in terms of OpenAPI 3.2, which readers of 3.1 refuse
                content[_STREAM] = {"schema": {"type": "string"}}
        app.openapi_schema = schema
    return app.openapi_schema


def _add_docs(app: FastAPI) -> None:
    """Swagger UI with scripts from a package on this machine."""
    package = importlib.util.find_spec("fastapi_offline")
    assert package is not None
    assert package.origin is not None
    app.mount("/docs-assets", StaticFiles(directory=Path(package.origin).parent / "static"), name="docs-assets")

    @app.get("/docs", include_in_schema=False)
    async def docs(request: Request) -> HTMLResponse:
        """The interactive documentation."""
        base = request.scope.get("root_path", "")
        return get_swagger_ui_html(
            openapi_url=f"{base}/api/openapi.json",
            title="OSF manipulation: REST interface",
            swagger_js_url=f"{base}/docs-assets/swagger-ui-bundle.js",
            swagger_css_url=f"{base}/docs-assets/swagger-ui.css",
            swagger_favicon_url=f"{base}/docs-assets/favicon.png",
        )
