"""What would a push do? Answered at once for many pushes at a time, and tried one by one on the table that is shown."""

from __future__ import annotations

import asyncio
import dataclasses
import json
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Response
from pydantic import BaseModel, FailFast, Field, FiniteFloat

from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import MAX_HORIZON, check_actions
from osfcore.geometry.states import MAX_OBJECTS, SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S
from osfcore.io.scene_file import rollouts_to_json
from osfcore.paper.method import Method

from ..jobs.params import ObjectName
from ..processes.messages.neural_messages import Predicted
from ..processes.messages.scene_messages import SceneRecord
from ..services.pushes import SPEED_M_S, NoPush, Push, PushState
from .bodies import BoundedRoute
from .dependencies import Services, ServicesDep, slow
from .models import Excerpt, Input, Position, Quaternion, Vector3, Velocity
from .problems import problems

_OVERHEAD = (0.0, 0.0, 1.0)
Sequence = Annotated[list[Velocity], Field(min_length=1, max_length=MAX_HORIZON), FailFast()]
_STATE_EXAMPLE = {
    "objects": [{"name": "006_mustard_bottle", "position": [0.0, 0.0, 0.095], "quaternion": [1.0, 0.0, 0.0, 0.0]}],
    "light": {"position": [0.3, -0.4, 0.8]},
    "pusher": {"position": [-0.12, 0.0, 0.062]},
}


class PlacedObject(Excerpt):
    """Where one object is."""

    name: ObjectName
    position: Position
    quaternion: Quaternion


class Place(Excerpt):
    """A place in the world."""

    position: Position


class StateIn(Excerpt):
    """Where everything is: what scene.json, state.json and /api/scenes hold can be sent as it is."""

    objects: list[PlacedObject] = Field(min_length=1, max_length=MAX_OBJECTS)
    light: Place | None = Field(None, description="Pushes do not depend on it.")
    pusher: Place | None = Field(None, description="Centre of the pusher; a prediction needs one.")

    def state(self) -> SceneState:
        """The core's state; raises InvalidInput if it makes no sense."""
        poses = Pose(
            np.array([placed.position for placed in self.objects], float),
            np.array([placed.quaternion for placed in self.objects], float),
        )
        light = Light(np.array(_OVERHEAD if self.light is None else self.light.position))
        pusher = None if self.pusher is None else np.array(self.pusher.position)
        return SceneState(tuple(placed.name for placed in self.objects), poses, light, pusher)


class PredictionIn(Input):
    """Sequences of actions to try, and from where."""

    actions: list[Sequence] = Field(
        min_length=1,
        max_length=1000,
        description="K sequences of T velocities of the pusher (vx, vy, 0) [m/s], each held for 0.2 s.",
        examples=[[[[0.3, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.0, 0.0]]]],
    )
    state: StateIn | None = Field(
        None, description="Null for the scene that is shown, with its true poses.", examples=[_STATE_EXAMPLE]
    )
    before: StateIn | None = Field(
        None, description="The same objects 0.2 s ago, with a state in which something may still be moving."
    )
    method: Method = Field(
        "ours", description='Whose model: "ours", or "paper", the graph network as published, which knows no "before".'
    )


class PredictionOut(BaseModel):
    """The futures; exactly as rollouts.json holds them, and more."""

    names: list[str] = Field(description="Of the N objects.")
    positions: list[list[list[Vector3]]] = Field(
        description="K x (T+1) x N x 3: before the first and after each action [m]."
    )
    quaternions: list[list[list[Quaternion]]] = Field(description="K x (T+1) x N x 4, (w, x, y, z).")
    pusher: list[list[Vector3]] = Field(description="Its centre, K x (T+1) x 3 [m]; it stops at the end of its reach.")
    step_s: float = Field(description="Time between two of them [s].")
    took_s: float = Field(description="Time that predicting took, without waiting and without loading [s].")
    scene: str | None = Field(description="Identifier of the scene from which it starts; null for a sent state.")
    revision: int | None = Field(description="Of that scene; once it has grown, the prediction is outdated.")


MAX_POSES = 100_000  # some 8 MB of JSON


class PushIn(Input):
    """A push to try from where the pusher is."""

    target: list[FiniteFloat] | None = Field(
        None,
        min_length=2,
        max_length=2,
        description="Where the pusher is to go, (x, y) [m]; null for beyond the nearest object.",
    )
    speed: float = Field(SPEED_M_S, ge=0.05, le=MAX_SPEED_M_S, description="Not to be exceeded [m/s].")


class OutcomeOut(BaseModel):
    """What a push does to an object; what it did is null before it is executed."""

    name: str
    label: str
    predicted_mm: float = Field(description="How far it is predicted to go.")
    predicted_deg: float = Field(description="How far it is predicted to turn.")
    went_mm: float | None
    turned_deg: float | None
    off_mm: float | None = Field(description="Between where it was predicted and where it is.")
    off_deg: float | None = Field(description="Likewise, between orientations that look different.")


class PushOut(BaseModel):
    """The push that is tried, the same for all visitors."""

    scene: str
    revision: int = Field(description="Of the scene from which it starts.")
    state: PushState = Field(description='"outdated" once the table has changed otherwise.')
    problem: str = Field(description="Why there is no prediction; empty if there is one, or will be.")
    actions: Sequence
    is_warm: bool = Field(description="Whether the network is loaded; the first prediction waits for it.")
    took_s: float = Field(description="Time that predicting took [s].")
    objects: list[OutcomeOut] = Field(description="Empty before it is predicted.")

    @staticmethod
    def of(services: Services, push: Push) -> PushOut:
        """From the service's own."""
        labels = services.objects.labels()
        rows = [
            OutcomeOut(label=labels.get(row.name, row.name), **dataclasses.asdict(row))
            for row in push.outcomes(services.runner.library)
        ]
        return PushOut(
            scene=push.record.id,
            revision=push.record.revision,
            state=push.state,
            problem=push.problem,
            actions=push.actions.tolist(),
            is_warm=services.pushes.is_warm,
            took_s=push.took_s,
            objects=rows,
        )


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
    if body.state is None:
        record = services.predictions.current()
        state = record.state
    else:
        record, state = None, body.state.state()
        known = services.fields.names()
        for name in state.names:
            if name not in known:  # 422; one that is on the table without a field is a matter of the present state, 409
                raise UnknownName("object with a field", name, known)
    actions = await asyncio.to_thread(_actions, body, len(state.names))
    submit = services.predictions.submit
    future = await asyncio.to_thread(submit, state, actions, before=before, method=body.method)
    answer = await asyncio.wrap_future(future)
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


def _json(answer: Predicted, record: SceneRecord | None) -> bytes:
    body = {
        **rollouts_to_json(answer.rollouts),
        "took_s": round(answer.took_s, 6),
        "scene": None if record is None else record.id,
        "revision": None if record is None else record.revision,
    }
    return json.dumps(body, allow_nan=False, separators=(",", ":")).encode()


push_router = APIRouter(prefix="/api/push", tags=["predictions"], responses=problems(), route_class=BoundedRoute)


@push_router.get("", responses=problems(404))
def get_push(services: ServicesDep) -> PushOut:
    """Return the push that is tried."""
    push = services.pushes.current
    if push is None:
        raise NoPush
    return PushOut.of(services, push)


@push_router.put("", responses=problems(409, 503))
def predict_push(services: ServicesDep, body: PushIn) -> PushOut:
    """Choose a push on the table that is shown, and predict it; nothing moves. Events of kind "push" bring the rest."""
    target = None if body.target is None else np.array(body.target)
    return PushOut.of(services, services.pushes.predict(target, body.speed))


@push_router.post("/execute", responses=problems(404, 409, 503))
@slow
def execute_push(services: ServicesDep) -> PushOut:
    """Carry out the push that was predicted, and compare."""
    push = services.pushes.execute()
    if push is None:  # dropped meanwhile
        raise NoPush
    return PushOut.of(services, push)


@push_router.delete("", status_code=204)
def drop_push(services: ServicesDep) -> None:
    """Forget the push that is tried; nothing moves back."""
    services.pushes.drop()
