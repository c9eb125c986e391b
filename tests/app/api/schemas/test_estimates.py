import pytest
from pydantic import ValidationError

from app.api.schemas.estimates import EstimateIn, EstimateOut
from app.jobs.job import Job
from app.services.estimates import Asked

OF = {"scene": "s", "revision": 2, "file_name": None}
PARAMS = {"mode": "next", "seed": 3, "of": OF, "names": ["a"], "cameras": ["0"]}


def test_nothing_asks_for_the_first_frame_of_the_current_scene():
    assert EstimateIn().asked() == Asked("first", 0, None)
    assert EstimateIn().scene is None
    for wrong in ({"mode": "second"}, {"seed": -1}, {"scene": ""}, {"seed": "1"}, {"more": 1}):
        with pytest.raises(ValidationError):
            EstimateIn.model_validate(wrong)


def test_an_estimate_tells_what_the_job_knows_and_what_it_has_made():
    steps = tuple(
        {
            "step": n,
            "stage": stage,
            "note": "x",
            "done": n,
            "total": 9,
            "losses": [0.5, None],
            "loss": None,
            "guess": {},
        }
        for n, stage in ((1, "light"), (2, "objects"))
    )
    out = EstimateOut.of_job(Job("j", "estimate", PARAMS, "running", 2, 9, "x"), steps, None, None)
    assert (out.id, out.mode, out.status, out.stage, out.objects) == ("j", "next", "running", "objects", ["a"])
    assert out.steps[0].losses == [0.5, None]
    assert "guess" not in out.model_dump()["steps"][0]
    assert (out.estimate, out.simulation) == (None, None)


def test_the_result_keeps_the_form_of_a_state_file():
    state = {
        "objects": [
            {"name": "a", "position": [0.1, 0, 0], "quaternion": [1, 0, 0, 0], "doubt": "",
             "uncertainty": {"position_std_m": None, "rotation_std_rad": 0.1}}
        ],
        "light": {"position": [0, 0, 1], "uncertainty": {"direction_std_rad": 0.1}},
        "trusted": True,
        "reason": "",
    }  # fmt: skip
    out = EstimateOut.of_job(Job("j", "estimate", PARAMS, "done"), (), state, {"objects": [], "light_deg": 0.1})
    assert out.model_dump(exclude_unset=True)["estimate"] == state
