"""The predicting process: answers where sequences of actions would lead. It starts when somebody first asks.

Only `predictor_main` is imported by the web process, by name; torch loads in the child.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from osfcore.errors import OsfError
from osfcore.fields.field_library import FieldLibrary
from osfcore.paper.method import Method

from .messages.neural_messages import Order, Predicted, PredictPushes
from .server import IsOvertaken, ProcessServer

if TYPE_CHECKING:
    from osfcore.dynamics.dynamics_model import DynamicsModel

_MOST_MODELS = 8


def predictor_main(server: ProcessServer, data_dir: Path) -> None:
    """Carry out orders until the service has gone."""
    server.serve(PushPredictor(data_dir).answer)


class PushPredictor:
    """Predicts; keeps the models of the latest sets of objects, and loads one again when one of its files has changed.

    Args:
        data_dir: where trained fields, and perhaps a trained network, are.
    """

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._fields = FieldLibrary(data_dir)
        self._models: OrderedDict[object, DynamicsModel] = OrderedDict()

    def answer(self, order: Order, is_overtaken: IsOvertaken = lambda: False) -> Predicted | None:
        """What answers an order; None if nobody waits for it any more.

        Raises:
            InvalidInput: if the state or the actions cannot be predicted.
            UnknownName: if an object has no field.
            CorruptFile: if a field or the network is broken.
        """
        if not isinstance(order, PredictPushes):
            raise TypeError(f"{type(order).__name__} is no prediction")
        if is_overtaken():
            return None
        model = self._model(order.state.names, order.method)
        start = time.perf_counter()
        rollouts = model.rollout(order.state, order.actions, order.before)
        took_s = time.perf_counter() - start
        if not all(np.isfinite(part).all() for part in (rollouts.positions, rollouts.quaternions, rollouts.pusher)):
            raise OsfError("The prediction runs out of all bounds, so there is none; begin with objects on the table.")
        return Predicted(rollouts, took_s)

    def _model(self, names: tuple[str, ...], method: Method) -> DynamicsModel:
        if method == "paper":
            from osfcore.paper.dynamics import load_paper_push_model as load
            from osfcore.paper.dynamics import weights_path as network
        else:
            from osfcore.dynamics.rollout import load_push_model as load
            from osfcore.dynamics.rollout import network_path as network

        chosen = tuple(sorted(names))
        stamps = [self._fields.stamp(name) for name in chosen]
        key = (method, chosen, *stamps, _stamp(network(self._data_dir)))
        if key not in self._models:
            self._models[key] = load(self._data_dir, self._fields, chosen)
            while len(self._models) > _MOST_MODELS:
                self._models.popitem(last=False)
        self._models.move_to_end(key)
        return self._models[key]


def _stamp(path: Path) -> object:
    """Changes when a file is written again or deleted."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
