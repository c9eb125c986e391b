"""Requests and responses that concern predictions of pushes."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, FailFast, Field

from app.api.schemas.common import Input, LightIn, ObjectName, Position, Quaternion, Vector3, Velocity
from app.api.schemas.limits import HORIZON, OBJECTS, SEQUENCES, sized
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.paper.method import Method

_OVERHEAD = (0.0, 0.0, 1.0)
Sequence = Annotated[list[Velocity], Field(**sized(HORIZON)), FailFast()]
_STATE_EXAMPLE = {
    "objects": [{"name": "006_mustard_bottle", "position": [0.0, 0.0, 0.095], "quaternion": [1.0, 0.0, 0.0, 0.0]}],
    "light": {"position": [0.3, -0.4, 0.8]},
    "pusher": {"position": [-0.12, 0.0, 0.062]},
}


class Told(BaseModel):
    """Part of a file or answer that tells more than is needed here; the rest is left alone."""

    model_config = ConfigDict(extra="ignore", strict=True)


class PlacedObject(Told):
    """Where one object is."""

    name: ObjectName
    position: Position
    quaternion: Quaternion


class Place(Told):
    """A place in the world."""

    position: Position


class StateIn(Told):
    """Where everything is: what scene.json, state.json and /api/scenes tell can be sent as it is."""

    objects: list[PlacedObject] = Field(**sized(OBJECTS))
    light: Place | None = Field(None, description="Pushes do not depend on it.")
    pusher: Place | None = Field(None, description="Centre of the pusher; a prediction needs one.")

    def state(self) -> SceneState:
        """The core's state; raises InvalidInput if it makes no sense."""
        poses = Pose(
            np.array([placed.position for placed in self.objects], float),
            np.array([placed.quaternion for placed in self.objects], float),
        )
        light = Light(np.array(_OVERHEAD)) if self.light is None else LightIn(position=self.light.position).light()
        pusher = None if self.pusher is None else np.array(self.pusher.position)
        return SceneState(tuple(placed.name for placed in self.objects), poses, light, pusher)


class PredictionIn(Input):
    """Sequences of actions to try, and from where."""

    actions: list[Sequence] = Field(
        **sized(SEQUENCES),
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
