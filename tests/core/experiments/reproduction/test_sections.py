from itertools import combinations, pairwise
from pathlib import Path

import pytest

from osfcore.experiments.factors import EPISODE_FACTORS
from osfcore.experiments.rearrangement import EvaluateMpc
from osfcore.experiments.rearrangement_runs import Variant, check_variant
from osfcore.experiments.reproduction.sections import QUICK, SECTIONS, Scale, sections_of

BASE = EvaluateMpc(Path("out"), Path("data"), names=("a", "b"), seed=7)


def named(name):
    return [section for section in sections_of(BASE, Scale()) if section.name == name]


@pytest.mark.parametrize("scale", [Scale(), QUICK], ids=["full", "quick"])
def test_cells_of_a_section_differ_but_have_the_same_tasks(scale):
    for section in sections_of(BASE, scale):
        assert len({cell.label for cell in section.cells}) == len(section.cells) > 1
        for one, other in combinations((cell.config for cell in section.cells), 2):
            assert one != other
            assert all(getattr(one, key) == getattr(other, key) for key in ("seed", "names", "tasks", "objects"))
        for cell in section.cells:
            check_variant(cell.config.variant)


def test_a_full_report_has_what_was_asked_for():
    methods = named("methods")
    assert [(s.cells[0].config.objects, s.cells[0].config.tasks) for s in methods] == [(2, 50), (3, 100), (4, 50)]
    assert all(cell.config.actions == cell.config.settings.steps == 30 for s in methods for cell in s.cells)
    assert [cell.config.oracle for cell in methods[1].cells] == [True, False, False, False, False, False]
    (factors,) = named("factors")
    assert {cell.config.factor for cell in factors.cells} == {"", *EPISODE_FACTORS}
    assert {section.name for section in sections_of(BASE, Scale())} == set(SECTIONS)
    assert {section.name for section in sections_of(BASE, Scale(), ("ladder",))} == {"ladder"}


def test_the_ladder_leads_from_the_paper_to_ours():
    (ladder,) = named("ladder")
    rungs = [cell.config.variant for cell in ladder.cells]
    assert rungs[0] == Variant("paper")
    assert rungs[-1] == Variant("ours")
    for lower, higher in pairwise(rungs[:-1]):
        assert lower.replaced < higher.replaced
        assert len(higher.replaced - lower.replaced) == 1
