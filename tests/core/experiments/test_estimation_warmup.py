import pytest

import osfcore.experiments.estimation_warmup as module
from osfcore.estimation import objective
from osfcore.experiments.estimation_warmup import WARM_SCENE, last_estimate, warm_models
from osfcore.experiments.fields import MAX_TASKS
from osfcore.world.tasks import draw_scene
from tests.core.experiments.oracle import Oracle
from tests.core.experiments.solids import SOLIDS


def test_every_kind_of_estimate_is_made_once_but_goals_only_where_they_are_measured(solids, library, monkeypatch):
    oracle = Oracle()
    oracle.install(monkeypatch)
    for name in ("first", "next", "goal"):
        monkeypatch.setattr(module, f"estimate_{name}", getattr(oracle, name))
    draw = draw_scene(SOLIDS[:1], 1, 0, WARM_SCENE)
    warm_models(SOLIDS[:1], solids, library, draw, 32, goal=False)
    models = warm_models(SOLIDS[:2], solids, library, draw, 32)
    assert [what for what, _ in oracle.asked] == [*["first search 4", "next"] * 2, "goal"]
    monkeypatch.setattr(objective, "resting_orientations", lambda _: pytest.fail("it was not known yet"))
    for name in SOLIDS[:2]:  # also of what is not in the scene
        assert len(models.resting(name).quaternions) > 0


def test_nothing_is_measured_on_the_scene():
    assert WARM_SCENE > MAX_TASKS


def test_an_estimate_without_an_end_is_a_mistake():
    with pytest.raises(AssertionError, match="last step"):
        last_estimate(iter(()))
