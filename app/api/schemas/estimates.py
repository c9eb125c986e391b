"""Requests and responses that concern estimates of poses and light."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from app.api.schemas.common import Input, Seed
from app.api.schemas.limits import NAME, sized
from app.api.schemas.paging import JobPageOut
from app.jobs.job import Job, State
from app.jobs.kinds.estimates import Mode
from app.services.estimates import Asked
from osfcore.io.scene_file import EstimateJson
from osfcore.paper.method import Method

METHOD = '"ours", or "paper": CMA-ES alone with fields as published, which is slower; not for mode "goal".'


class EstimateIn(Input):
    """An estimate of what the cameras see of a scene."""

    mode: Mode = Field(
        "first",
        description='"first" from masks alone, "next" without masks from an earlier estimate, "goal" from one view '
        "without masks and without the pusher.",
    )
    scene: str | None = Field(None, **sized(NAME), description="Null for the one that is shown.")
    prior: str | None = Field(
        None, **sized(NAME), description="The earlier estimate; null for the latest one of the scene."
    )
    seed: Seed = 0
    method: Method = Field("ours", description=METHOD)

    def asked(self) -> Asked:
        """What the service's own modules take."""
        return Asked(self.mode, self.seed, self.prior, self.method)


class ObservedOut(BaseModel):
    """What was looked at."""

    scene: str | None = Field(description="Identifier of the scene; null for an upload.")
    revision: int | None = Field(description="Of the scene when its images were taken.")
    file_name: str | None = Field(description="Of the upload; null for a scene.")


class StepOut(BaseModel):
    """One step of an estimate."""

    step: int = Field(description="From 1; names the step's images.")
    stage: str = Field(description='"orientations", "light", "objects", "together", "polish" or "done".')
    note: str
    done: int
    total: int
    losses: list[float | None] = Field(description="Of each object, in the units of the stage.")
    loss: float | None = Field(description="Of the whole, likewise; null where only objects are looked at.")


class ObjectError(BaseModel):
    """How far one object is from where it truly is."""

    name: str
    position_mm: float
    rotation_deg: float = Field(description="Least angle over all orientations that look like the true one.")


class SimulationErrors(BaseModel):
    """Errors against the truth, which only a simulation knows and no estimator sees."""

    objects: list[ObjectError]
    light_deg: float


class EstimateOut(BaseModel):
    """An estimate as it is now."""

    id: str
    mode: Mode
    method: Method
    seed: int
    of: ObservedOut
    objects: list[str] = Field(description="Names, in the order of losses.")
    cameras: list[str] = Field(description="Names, in the order of views.")
    status: State
    position: int | None = Field(description="Place in the queue, 1 is next; null when not queued.")
    done: int = Field(description="Units finished.")
    total: int = Field(description="Units in all; 0 before it is known.")
    stage: str | None
    note: str
    eta_s: float | None = Field(description="Estimated time left [s].")
    created_at: str
    started_at: str | None
    finished_at: str | None
    error: str | None
    steps: list[StepOut] = Field(description="All steps so far, with their losses.")
    estimate: EstimateJson | None = Field(description="The result, as in state.json; null until it is there.")
    simulation: SimulationErrors | None = Field(
        description="Simulation only: errors against the truth; null for uploads and before the result is there."
    )
    files: list[str] = Field(description="Names to download from /api/jobs/{id}/files/{name}.")

    @staticmethod
    def of_job(
        job: Job, steps: tuple[dict[str, Any], ...], estimate: EstimateJson | None, errors: dict[str, Any] | None
    ) -> EstimateOut:
        """From the registry's job and what it has made.

        Args:
            job: of the kind "estimate".
            steps: as `read_steps` tells them; none where they are not asked for.
            estimate: the result; None before it is there, or where it is not asked for.
            errors: against the truth, as `errors_of` tells them; None where nobody knows it.
        """
        return EstimateOut(
            id=job.id,
            mode=job.params["mode"],
            method=job.params.get("method", "ours"),
            seed=job.params["seed"],
            of=ObservedOut(**job.params["of"]),
            objects=job.params["names"],
            cameras=job.params["cameras"],
            status=job.state,
            position=job.position,
            done=job.done,
            total=job.total,
            stage=steps[-1]["stage"] if steps else None,
            note=job.note,
            eta_s=job.eta_s,
            created_at=job.created_at,
            started_at=job.started_at,
            finished_at=job.finished_at,
            error=job.error,
            steps=[StepOut(**{key: step[key] for key in StepOut.model_fields}) for step in steps],
            estimate=estimate,
            simulation=None if errors is None else SimulationErrors.model_validate(errors),
            files=list(job.files),
        )


class EstimateList(JobPageOut):
    """Estimates, newest first, without their steps."""

    estimates: list[EstimateOut]
