"""What the data directory holds, and what unfinished trainings have left in it."""

from typing import Annotated

from fastapi import APIRouter, Path, status

from app.api.dependencies import ServicesDep
from app.api.problems import named_in_path
from app.api.routes import problems
from app.api.schemas.storage import LeftoverList, LeftoverOut, StorageOut

router = APIRouter(prefix="/api/storage", tags=["storage"], responses=problems())


@router.get("")
def usage(services: ServicesDep) -> StorageOut:
    """Tell how much the data directory holds, by kind, and how much it may."""
    storage = services.runner.storage
    usage = storage.usage()
    return StorageOut(
        bytes=usage.bytes if usage else None,
        total=usage.total if usage else None,
        seconds_ago=round(usage.seconds_ago, 3) if usage else None,
        allowed=storage.max_bytes or None,
        free=storage.free_bytes,
        must_stay_free=storage.min_free_bytes,
    )


@router.get("/training")
def leftovers(services: ServicesDep) -> LeftoverList:
    """List what trainings have left that failed, and what those that go on have made."""
    jobs = {job.params["name"]: job.id for job in services.runner.jobs.live("train_field")}
    return LeftoverList(
        leftovers=[
            LeftoverOut(name=left.name, bytes=left.bytes, changed_at=left.changed_at, job=jobs.get(left.name))
            for left in services.runner.leftovers()
        ]
    )


@router.delete("/training/{name}", status_code=status.HTTP_204_NO_CONTENT, responses=problems(404, 409, 507))
def delete_leftover(services: ServicesDep, name: Annotated[str, Path(description="Of a field.")]) -> None:
    """Delete what a training has left; the same order then begins anew."""
    with named_in_path():
        services.runner.remove_leftover(name)
