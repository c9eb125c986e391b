"""`osf collect`: image sets, pushes and observations from the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from app.cli.command import Command, DataCommand, Flat, follow
from app.cli.workers import worker_pool
from osfcore.world.collect_images import (
    CollectObject,
    CollectObservation,
    CollectTable,
    collect_object,
    collect_observation,
    collect_table,
)
from osfcore.world.collect_pushes import CollectPushes, collect_pushes

_IN_FLIGHT = 64  # episodes that a cluster is given at once


@dataclass(frozen=True)
class CollectObjectCommand(DataCommand, CollectObject):
    """Images of one object from all sides under lights from all directions, in the OSF format."""

    name: tyro.conf.Positional[str]
    """Name of the object, such as 006_mustard_bottle."""

    def run(self) -> dict[str, Any]:
        """Collect; the result names the folder and the counts."""
        last = follow(collect_object(self, self.assets))
        return {"out": str(self.out), "images": last.total if last else 0}


@dataclass(frozen=True)
class CollectTableCommand(Command, CollectTable):
    """Images of the bare table under many lights, in the OSF format."""

    def run(self) -> dict[str, Any]:
        """Collect; the result names the folder and the counts."""
        last = follow(collect_table(self))
        return {"out": str(self.out), "images": last.total if last else 0}


@dataclass(frozen=True)
class CollectPushesCommand(DataCommand):
    """Episodes of pushes for learning dynamics. A killed collection goes on where it was when started again."""

    settings: Flat[CollectPushes]
    workers: int = 2
    """Processes that simulate side by side; the content does not depend on it."""
    cluster: str | None = None
    """Address of a Dask scheduler whose workers simulate instead; they need the same data folder."""

    def run(self) -> dict[str, Any]:
        """Collect; the result has the shares of steps with contact and motion, and the rate."""
        settings = self.settings
        in_flight = self.workers + 2 if self.cluster is None else _IN_FLIGHT
        with worker_pool(self.workers, self.cluster) as executor:
            last = follow(collect_pushes(settings, self.assets, executor, in_flight))
        result: dict[str, Any] = {"out": str(settings.out), "episodes": settings.episodes, "steps": settings.steps}
        if last is not None:
            result |= {
                "contact_share": round(last.contact_share, 4),
                "motion_share": round(last.motion_share, 4),
                "episodes_per_s": round(last.episodes_per_s, 2),
            }
        return result


@dataclass(frozen=True)
class CollectObservationCommand(DataCommand, CollectObservation):
    """One observation of a random scene, to try 'osf estimate' with; truth.json in it has what was there."""

    def run(self) -> dict[str, Any]:
        """Collect; the result names the folder and what is to be seen."""
        made = collect_observation(self, self.assets, self.trained.names())
        views = "1 view" if len(made.cameras) == 1 else f"{len(made.cameras)} views"
        self.say(f"Wrote {self.out}: {views} of {', '.join(made.names)}.")
        return {"out": str(self.out), "objects": list(made.names), "cameras": [c.name for c in made.cameras]}


Collect = Annotated[
    Annotated[CollectObjectCommand, tyro.conf.subcommand("object")]
    | Annotated[CollectTableCommand, tyro.conf.subcommand("table")]
    | Annotated[CollectPushesCommand, tyro.conf.subcommand("pushes")]
    | Annotated[CollectObservationCommand, tyro.conf.subcommand("observation")],
    tyro.conf.OmitSubcommandPrefixes,
]
