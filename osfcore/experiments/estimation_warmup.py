"""What is done once in a program's life and belongs to no estimate: loading fields, compiling code, finding rests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from osfcore.estimation.first_frame import FirstFrameConfig, estimate_first
from osfcore.estimation.goal_image import GoalImageConfig, estimate_goal
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.estimation.tracking import TrackingConfig, estimate_next
from osfcore.experiments.estimation_tasks import first_frame, goals
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.states import EstimatedState
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.tasks import Draw

WARM_SCENE = 900_000  # number of a scene that no figure is measured on
_FIRST = FirstFrameConfig(
    starts=1,
    population=4,
    generations=1,
    joint_population=4,
    joint_generations=1,
    coarse_iterations=1,
    fine_iterations=1,
)
# Thresholds of 0 make both search as they do where an object does not fit.
_NEXT = TrackingConfig(fits_below=0.0, lamp_above=0.0, sweeps=1, generations=1)
_GOAL = GoalImageConfig(planar_iterations=1, free_iterations=1, widen_all=True)


def warm_models(
    names: Sequence[str], fields: FieldLibrary, library: AssetLibrary, draw: Draw, size: int, *, goal: bool = True
) -> ObjectModels:
    """Fields of objects and table, with everything done that only the first estimate would pay for.

    Args:
        names: of the objects.
        fields: where the fields are.
        library: where the objects' meshes are, for pictures to warm up with.
        draw: a scene of some of the objects, on which nothing is measured.
        size: side of the images [px].
        goal: goals will be estimated too.
    """
    models = ObjectModels({name: fields.load(name) for name in names}, fields.load_table())
    for name in names:
        models.resting(name)
    rng = stream_rng(0, Stream.BENCHMARK)
    observation = first_frame(draw, library, default_cameras(size)).observation
    state = last_estimate(estimate_first(models, observation, rng, _FIRST)).state
    last_estimate(estimate_next(models, replace(observation, masks=None), state, rng, _NEXT))
    if goal:
        view = goals(draw, library, goal_camera(size))[0].frame.observation
        last_estimate(estimate_goal(models, view, state, _GOAL))
    return models


def last_estimate(steps: Iterator[EstimateStep]) -> EstimatedState:
    """Run through the steps of an estimate; what the last one holds."""
    estimate = None
    for step in steps:
        estimate = step.estimate
    assert estimate is not None, "the last step brings the estimate"
    return estimate
