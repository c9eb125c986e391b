from pathlib import Path

import pytest

from osfcore.control.estimators import load_scene_models
from osfcore.errors import InvalidInput
from osfcore.experiments.rearrangement_runs import METHODS, TRUTHS, Variant, check_variant, loop_parts
from osfcore.experiments.rivals.nerf import UnlitRenderer
from osfcore.fields.field_library import FieldLibrary
from osfcore.paper.rendering import PaperRenderer
from osfcore.paper.stages import STAGES, PaperEstimators
from osfcore.render.renderer import SceneRenderer
from osfcore.world.tasks import TaskSet, draw_task

NAME = "009_gelatin_box"


@pytest.mark.parametrize(
    ("variant", "words"),
    [
        (Variant("magic"), "method is 'magic'"),
        (Variant("ours", frozenset({"fields"})), "stages of ours is fields, .*method paper alone"),
        (Variant("paper", frozenset({"hands"})), "stages of ours is hands, .*fields, estimation, dynamics, planning"),
        (Variant("paper", frozenset(STAGES)), "method ours is what replaces all"),
        (Variant("paper", truths=frozenset({"goal"})), "method ours alone"),
        (Variant("ours", truths=frozenset({"luck"})), "poses, goal, dynamics"),
        (Variant(views=0), "number of views is 0"),
        (Variant(views=5), "between 1 and 4"),
        (Variant(has_masks=True), "masks at every step is given"),
        (Variant("paper", frozenset({"planning"}), has_masks=True), "left out"),
        (Variant("foresight", views=2), "which has the goal's view"),
    ],
)
def test_what_cannot_be_combined_is_refused(variant, words):
    with pytest.raises(InvalidInput, match=words):
        check_variant(variant)


def test_variants_that_differ_have_names_that_differ():
    variants = [Variant(method) for method in METHODS]
    variants += [Variant("paper", frozenset({stage})) for stage in STAGES]
    variants += [Variant(truths=frozenset({truth})) for truth in TRUTHS]
    variants += [Variant(views=views) for views in (1, 2, 3)]
    variants.append(Variant("paper", has_masks=True))
    for variant in variants:
        check_variant(variant)
    assert len({variant.name() for variant in variants}) == len(variants)


def test_a_loop_is_made_of_what_its_method_has(library):
    task = draw_task(library, TaskSet((NAME,), objects=1), 1).task
    models = load_scene_models((NAME,), FieldLibrary(None), library, None)

    def made(variant):
        return loop_parts(variant, models, task, FieldLibrary(None), None)

    assert made(Variant()).models is models
    assert made(Variant("known_light")).estimators.first.held_light == tuple(task.start.light.direction)
    assert made(Variant("overhead")).estimators.goal.held_light == (0, 0, 1)
    assert isinstance(made(Variant("nerf")).models.appearance.together, UnlitRenderer)
    published = made(Variant("paper", frozenset({"estimation", "dynamics", "planning"})))
    assert isinstance(published.models.appearance.together, PaperRenderer)
    assert published.models.dynamics is models.dynamics
    assert not isinstance(published.estimators, PaperEstimators)
    looked = made(Variant("paper", frozenset({"fields", "dynamics", "planning"})))
    assert isinstance(looked.models.appearance.together, SceneRenderer)
    assert isinstance(looked.estimators, PaperEstimators)


def test_fields_without_light_are_read_from_the_data_folder_first(tmp_path: Path):
    from osfcore.experiments.rivals.nerf import nerf_library

    assert nerf_library(tmp_path).folder(NAME) == tmp_path / "nerf" / "fields" / NAME
    assert nerf_library(None).info(NAME).source == "shipped"
