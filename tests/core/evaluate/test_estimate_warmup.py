import pytest

import osfcore.evaluate.estimate_warmup as module
from osfcore.evaluate.composites import draw_scene
from osfcore.evaluate.estimate_warmup import WARM_SCENE, last_estimate, warm_models
from osfcore.evaluate.fields import MAX_TASKS
from tests.core.evaluate.solids import SOLIDS


@pytest.mark.parametrize("goal", [True, False])
def test_every_kind_of_estimate_is_made_once(solids, library, monkeypatch, goal):
    made, found = [], []

    def counted(name):
        real = getattr(module, name)

        def run(*args):
            made.append(name)
            for step in real(*args):
                found.append(step.estimate)
                yield step

        return run

    for name in ("estimate_first", "estimate_next", "estimate_goal"):
        monkeypatch.setattr(module, name, counted(name))
    models = warm_models(SOLIDS[:2], solids, library, draw_scene(SOLIDS[:1], 1, 0, WARM_SCENE), 32, goal=goal)
    assert made == ["estimate_first", "estimate_next", "estimate_goal"][: 2 + goal]
    assert sum(estimate is not None for estimate in found) == len(made)
    assert set(models._resting) == set(SOLIDS[:2])  # also of what is not in the scene


def test_nothing_is_measured_on_the_scene():
    assert WARM_SCENE > MAX_TASKS


def test_an_estimate_without_an_end_is_a_mistake():
    with pytest.raises(AssertionError, match="last step"):
        last_estimate(iter(()))
