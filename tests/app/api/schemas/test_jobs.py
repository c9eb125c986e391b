import pytest
from pydantic import TypeAdapter, ValidationError

from app.api.schemas.jobs import JobIn, JobOut
from app.jobs.job import Job


def test_jobs_are_told_apart_by_kind():
    adapter = TypeAdapter(JobIn)
    job = adapter.validate_python({"kind": "collect_pushes", "params": {"episodes": 2}})
    assert job.params.model_dump()["steps"] == 50
    with pytest.raises(ValidationError):
        adapter.validate_python({"kind": "collect_object"})
    with pytest.raises(ValidationError):
        adapter.validate_python({"kind": "collect_pushes", "params": {"out": "/etc/passwd"}})


def test_a_job_says_what_the_registry_says():
    out = JobOut.of(Job("a", "collect_table", {"images": 60}, files=("table.zip",), position=2))
    assert (out.files, out.position, out.state) == (["table.zip"], 2, "queued")


def test_a_field_is_learned_from_a_mesh_or_from_a_set_and_never_both():
    adapter = TypeAdapter(JobIn)
    order = {"kind": "train_field", "params": {"name": "mug", "source": {"mesh": "025_mug"}, "minutes": 1}}
    params = adapter.validate_python(order).params.model_dump()
    assert params["source"] == {"mesh": "025_mug", "set": None}
    assert (params["minutes"], params["images"], params["seed"]) == (1, 300, 0)
    for source in ({}, {"mesh": "a", "set": "b"}, {"folder": "/etc"}):
        with pytest.raises(ValidationError):
            adapter.validate_python({"kind": "train_field", "params": {"name": "mug", "source": source}})
    with pytest.raises(ValidationError, match="minutes"):
        adapter.validate_python({"kind": "train_field", "params": {**order["params"], "minutes": 0}})
