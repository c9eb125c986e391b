from itertools import combinations, pairwise
from pathlib import Path

import pytest

from osfcore.experiments.factors import EPISODE_FACTORS
from osfcore.experiments.rearrangement import EvaluateMpc
from osfcore.experiments.rearrangement_runs import Variant, check_variant
from osfcore.experiments.reproduction.sections import QUICK, SECTIONS, Scale, sections_of

BASE = EvaluateMpc(Path("out"), Path("data"), names=("a", "b"), seed=7)


def named(name, scale):
    return [section for section in sections_of(BASE, scale) if section.name == name]


@pytest.mark.parametrize("scale", [Scale(), QUICK], ids=["full", "quick"])
def test_cells_of_a_section_differ_in_one_thing_at_a_time(scale):
    for section in sections_of(BASE, scale):
        labels = [cell.label for cell in section.cells]
        assert len(set(labels)) == len(labels) > 1
        for one, other in combinations((cell.config for cell in section.cells), 2):
            assert one != other
            assert (one.seed, one.names, one.tasks, one.objects) == (
                other.seed,
                other.names,
                other.tasks,
                other.objects,
            )
        for cell in section.cells:
            check_variant(cell.config.variant)


def test_a_full_report_has_what_was_asked_for():
    methods = named("methods", Scale())
    assert [section.cells[0].config.objects for section in methods] == [2, 3, 4]
    assert [section.cells[0].config.tasks for section in methods] == [50, 100, 50]
    assert all(cell.config.actions == cell.config.settings.steps == 30 for s in methods for cell in s.cells)
    assert [cell.config.oracle for cell in methods[1].cells] == [True, False, False, False, False, False]
    (factors,) = named("factors", Scale())
    assert {cell.config.factor for cell in factors.cells} == {"", *EPISODE_FACTORS}
    (families,) = named("families", Scale())
    assert [cell.config.family for cell in families.cells] == ["shifted", "turned", "crowded", "relit"]


def test_the_ladder_leads_from_the_paper_to_ours():
    (ladder,) = named("ladder", Scale())
    rungs = [cell.config.variant for cell in ladder.cells]
    assert rungs[0] == Variant("paper")
    assert rungs[-1] == Variant("ours")
    for lower, higher in pairwise(rungs[:-1]):
        assert lower.replaced < higher.replaced
        assert len(higher.replaced - lower.replaced) == 1


def test_parts_can_be_left_out():
    assert {section.name for section in sections_of(BASE, Scale())} == set(SECTIONS)
    assert {section.name for section in sections_of(BASE, Scale(), ("ladder",))} == {"ladder"}
