import json

import numpy as np
import pytest
from PIL import Image

from osfcore.dynamics.rollout import load_push_model
from osfcore.experiments.visual_prediction import VisualPrediction, show_prediction
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.metrics.image_errors import psnr
from osfcore.render.renderer import SceneRenderer
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

NAMES = ("005_tomato_soup_can", "009_gelatin_box")


@pytest.fixture(scope="module")
def prediction(library):
    """Two steps away from everything, so that predicted and true scenes are the same."""
    world = Tabletop(library, request=SceneRequest(names=NAMES))
    world.arrange(3)
    state = world.truth()
    world.close()
    model = load_push_model(None, FieldLibrary(None), NAMES)
    away = state.pusher[:2] - state.poses.position[:, :2].mean(axis=0)
    actions = np.zeros((1, 2, 3))
    actions[..., :2] = 0.1 * away / np.linalg.norm(away)
    return state, model.rollout(state, actions), actions


@pytest.fixture(scope="module")
def renderer():
    fields = FieldLibrary(None)
    return SceneRenderer({name: fields.load(name) for name in NAMES}, fields.load_table())


def test_predicted_pictures_lie_beside_the_simulators(prediction, renderer, library, tmp_path):
    state, rollouts, actions = prediction
    wanted = VisualPrediction(state, rollouts, actions, 0, default_cameras()[1], tmp_path)
    steps = list(show_prediction(wanted, renderer, library))
    assert (steps[-1].done, steps[-1].total) == (3, 3)
    found = json.loads((tmp_path / "psnr.json").read_text())
    assert found["camera"] == "1"
    assert len(found["psnr"]) == 3
    assert min(found["psnr"]) > 28  # nothing has moved but the pusher, which is known
    for step, value in enumerate(found["psnr"]):
        ours, true = (np.asarray(Image.open(tmp_path / f"{step:03d}{kind}.png")) / 255 for kind in ("", "_true"))
        assert psnr(true, ours) == pytest.approx(value, abs=0.5)  # files have 8 bits
    assert (tmp_path / "prediction.png").exists()


def test_without_meshes_there_are_predictions_alone(prediction, renderer, tmp_path):
    state, rollouts, actions = prediction
    wanted = VisualPrediction(state, rollouts, actions, 0, default_cameras()[0], tmp_path)
    assert len(list(show_prediction(wanted, renderer, None))) == 4
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000.png", "001.png", "002.png"]
