"""Solids to measure on, and episodes that cost nothing."""

from types import SimpleNamespace

import numpy as np
import pytest

import osfcore.experiments.rearrangement as measured
from osfcore.control.events import ActionExecuted, Finished, GoalFound, Noticed, Stepped
from osfcore.experiments import rearrangement_runs as methods
from osfcore.experiments.factors import Factor
from osfcore.experiments.rearrangement_runs import Ended
from osfcore.experiments.rivals.visual_foresight import Foreseen, ForesightPlan
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.states import EstimatedState
from osfcore.objects.catalogue import CATALOGUE
from osfcore.planning.costs import PoseGoal
from tests.core.dynamics.conftest import shapes, table  # noqa: F401 - fixtures
from tests.support.solids import write_fields

SYMMETRIES = {name: info.symmetry for name, info in CATALOGUE.items()}
PAPER = np.full((16, 16, 3), 0.5)


@pytest.fixture
def runs(monkeypatch):
    """Runs that cost nothing: ours reach the goal, odd ones with a doubt; the oracle's leave everything as it is.

    Tells which were made.
    """
    made = []

    def ours(task, _assets, parts, settings, _rng, factor, variant, published):
        held = parts.estimators.first.held_light
        assert (held is None) == (parts.estimators.goal.held_light is None)
        assert (held == (0, 0, 1)) == (variant.method in ("overhead", "nerf"))
        assert isinstance(factor, Factor)
        made.append((variant.method, task.number, published.samples if variant.method == "paper" else settings.cost))
        assert settings.despite_doubts
        one, doubt = np.full(len(task.start.names), 1e-3), "hidden" if task.number % 2 else ""
        estimate = EstimatedState(task.goal, one, one, 1e-3, ("",) * len(one), doubt)
        yield GoalFound(PoseGoal(task.goal.names, task.goal.poses), PAPER, goal_camera(16), estimate)
        if doubt:
            yield Noticed(0, "goal", "The goal image is not explained well: hidden.")
        yield Stepped(0, 2, estimate, 0 * one, 0 * one, 0.0, PAPER, {"first": 8.0, "goal": 20.0})
        for number, plan_s in ((1, 1.0), (2, 3.0)):
            yield ActionExecuted(number, np.zeros(3))
            yield Stepped(number, 2, estimate, 0 * one, 0 * one, 0.0, PAPER, {"plan": plan_s, "estimate": 0.5})
        yield Finished(2, "reached", "The table looks like the goal.", task.goal)
        yield Ended(task.goal, PAPER, PAPER)

    def foresight(task, _assets, _predictor, settings, steps, _rng, _factor, _size):
        made.append(("foresight", task.number, steps))
        plan = ForesightPlan(np.zeros((1, 3)), np.zeros(2), 2.5)
        yield from (Foreseen(number, np.zeros(3), plan, PAPER) for number in range(steps))
        yield Ended(task.start, PAPER, PAPER)

    def told(task, _assets, _models, settings, _rng, *, knows_pushes, simulator):
        made.append(("oracle", task.number, "simulator" if knows_pushes else "network", settings.plan.samples))
        return Ended(task.start, PAPER, PAPER)

    monkeypatch.setattr(measured, "run_from_images", ours)
    monkeypatch.setattr(measured, "run_told_the_truth", told)
    monkeypatch.setattr(measured, "run_visual_foresight", foresight)
    monkeypatch.setattr(measured, "load_scene_models", lambda *_: SimpleNamespace(symmetries=SYMMETRIES))
    for appearance in ("with_nerfs", "with_paper_stages"):
        monkeypatch.setattr(methods, appearance, lambda models, *_: models)
    return made


@pytest.fixture(scope="session")
def solids(library, tmp_path_factory) -> FieldLibrary:
    """Three objects with a field and a mesh, and the table."""
    data_dir = tmp_path_factory.mktemp("solids")
    write_fields(data_dir, library)
    return FieldLibrary(data_dir, shipped=data_dir / "none")
