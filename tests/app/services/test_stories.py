import json

import pytest

from app.episodes.trajectory import ReplayClock, read_trajectory
from app.services.examples import PRESETS, Stories
from osfcore.control.prepared import prepared_from_json
from osfcore.errors import CorruptFile, UnknownName

MOST_BYTES = 2_000_000


def test_every_example_has_a_story_and_it_is_small():
    stories = Stories()
    assert set(stories.names()) == {preset.id for preset in PRESETS}
    for name in stories.names():
        folder = stories.trajectory(name).parent
        assert sum(path.stat().st_size for path in folder.iterdir()) < MOST_BYTES


@pytest.mark.parametrize("preset", PRESETS, ids=lambda preset: preset.id)
def test_a_story_tells_of_its_example_what_its_course_shows(preset):
    stories = Stories()
    told, course = stories.shown(preset.id), read_trajectory(stories.trajectory(preset.id))
    assert told["objects"] == list(course.names) == list(preset.objects)
    assert len(told["moved"]) == len(preset.shifts_m)
    assert told["step_s"] == pytest.approx(ReplayClock(course).step_s, abs=1e-3)
    assert len(told["left_mm"]) == len(told["step_s"]) == len(course.rounds)
    assert told["pushes"] == len(course.states) - 1
    assert told["outcome"] == "reached"
    assert max(told["left_mm"][-1].values()) < 20
    prepared = prepared_from_json(json.loads(stories.prepared(preset.id).read_text()))
    assert prepared.first.estimate.state.names == prepared.goal.estimate.state.names == course.names
    assert prepared.first.estimate.trusted
    assert prepared.goal.estimate.trusted


def test_what_is_not_there_is_told(tmp_path):
    stories = Stories(tmp_path)
    assert stories.names() == ()
    assert stories.prepared("first") is None
    with pytest.raises(UnknownName):
        stories.trajectory("../first")
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "story.json").write_text("[]")
    with pytest.raises(CorruptFile):
        stories.shown("odd")
