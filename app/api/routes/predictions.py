"""What would a push do? Answered at once, for many pushes at a time."""

import asyncio
import functools
import json
from typing import Any

import numpy as np
from fastapi import APIRouter, Response

from app.api.bodies import BoundedRoute
from app.api.dependencies import ServicesDep
from app.api.routes import problems
from app.api.schemas.predictions import PredictionIn, PredictionOut
from app.processes.messages.neural_messages import Predicted
from app.processes.messages.scene_messages import SceneRecord
from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.rollouts import check_actions
from osfcore.geometry.states import SceneState
from osfcore.io.scene_file import rollouts_to_json

MAX_POSES = 100_000  # some 8 MB of JSON
_ANSWER: dict[int | str, dict[str, Any]] = {200: {"model": PredictionOut, "description": "The predicted futures."}}
router = APIRouter(prefix="/api/predictions", tags=["predictions"], route_class=BoundedRoute)


@router.post("", response_class=Response, responses={**problems(409, 503), **_ANSWER})
async def predict(services: ServicesDep, body: PredictionIn) -> Response:
    """Predict what sequences of pushes would do, in the scene that is shown or in a state that is sent.

    Open loop, from a network that has learned from pushes; nothing moves in the simulation. The first time, this waits
    for the network to load.
    """
    before = None if body.before is None else body.before.state()
    if before is not None and body.state is None:
        raise InvalidInput("state", "missing", "given together with what was before")
    if before is not None and body.method == "paper":
        raise InvalidInput("before", "given", "left out with the method as published, which has no velocities")
    record, state = (services.predictions.current(), None) if body.state is None else (None, body.state.state())
    if state is None:
        assert record is not None
        state = record.state
    else:
        _check_known(state, services.fields.names())
    actions = await asyncio.to_thread(_actions, body, len(state.names))
    order = functools.partial(services.predictions.submit, state, actions, before=before, method=body.method)
    answer = await asyncio.wrap_future(await asyncio.to_thread(order))
    assert isinstance(answer, Predicted)  # nothing overtakes an order with a key of its own
    content = await asyncio.to_thread(_json, answer, record)
    return Response(content, media_type="application/json")


def _actions(body: PredictionIn, objects: int) -> np.ndarray:
    lengths = {len(sequence) for sequence in body.actions}
    if len(lengths) > 1:
        raise InvalidInput("lengths of the sequences", sorted(lengths)[:5], "the same for all")
    actions = check_actions(body.actions)
    poses = len(actions) * (actions.shape[1] + 1) * objects
    if poses > MAX_POSES:
        raise InvalidInput("number of poses in the answer, K x (T+1) x N,", poses, f"at most {MAX_POSES}")
    return actions


def _check_known(state: SceneState, known: tuple[str, ...]) -> None:
    """What is sent names objects as it likes; what is on the table is a matter of the present state (409)."""
    for name in state.names:
        if name not in known:
            raise UnknownName("object with a field", name, known)


def _json(answer: Predicted, record: SceneRecord | None) -> bytes:
    body = {
        **rollouts_to_json(answer.rollouts),
        "took_s": round(answer.took_s, 6),
        "scene": None if record is None else record.id,
        "revision": None if record is None else record.revision,
    }
    return json.dumps(body, allow_nan=False, separators=(",", ":")).encode()
