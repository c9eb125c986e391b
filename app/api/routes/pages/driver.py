"""Who has the controls of the page, where several people watch it."""

from typing import Annotated

from fastapi import APIRouter
from pydantic import BaseModel, Field

from app.api.bodies import BoundedRoute
from app.api.dependencies import ServicesDep
from app.api.routes import problems
from app.api.schemas.common import Input
from app.api.schemas.limits import NAME, VISITOR, sized

router = APIRouter(prefix="/api/driver", tags=["driver"], responses=problems(), route_class=BoundedRoute)
Visitor = Annotated[str, Field(**sized(NAME), pattern=f"^{VISITOR}$", description="What a page calls itself.")]


class DriverIn(Input):
    """A page that wants to drive."""

    visitor: Visitor


class DriverOut(BaseModel):
    """Who drives, and among how many."""

    driver: str | None = Field(description="What the page calls itself; null while no page is open.")
    visitors: int


@router.get("")
async def get(services: ServicesDep) -> DriverOut:
    """Tell who drives."""
    return DriverOut.model_validate(services.driver.now(), from_attributes=True)


@router.post("")
def take(services: ServicesDep, body: DriverIn) -> DriverOut:
    """Let a page drive from now on; programs are never asked who they are."""
    return DriverOut.model_validate(services.driver.take(body.visitor), from_attributes=True)
