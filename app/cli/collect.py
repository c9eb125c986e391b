"""`osf collect`: image sets, pushes and observations from the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from .command import Command, DataCommand, choice_of, last_of, options_as
from .workers import worker_pool

_IN_FLIGHT = 64  # episodes that a cluster is given at once


@dataclass(frozen=True)
class CollectObjectCommand(DataCommand):
    """Images of one object from all sides under lights from all directions, in the OSF format."""

    name: tyro.conf.Positional[str]
    """Name of the object, such as 006_mustard_bottle."""
    out: Path
    """Folder to write; must be new or empty."""
    images: int = 300
    """Train and test images together; one in eight, at least 40, are for testing."""
    size: int = 128
    """Side of the square images [px]."""
    seed: int = 0
    """Of views and lights."""

    def run(self) -> dict[str, Any]:
        """Collect; the result names the folder and the counts."""
        from osfcore.world.collect_images import CollectObject, collect_object

        last = last_of(collect_object(options_as(CollectObject, self), self.assets))
        return {"out": str(self.out), "images": last.total}


@dataclass(frozen=True)
class CollectTableCommand(Command):
    """Images of the bare table under many lights, in the OSF format."""

    out: Path
    """Folder to write; must be new or empty."""
    images: int = 300
    """Train and test images together; one in eight, at least 40, are for testing."""
    size: int = 128
    """Side of the square images [px]."""
    seed: int = 0
    """Of views and lights."""

    def run(self) -> dict[str, Any]:
        """Collect; the result names the folder and the counts."""
        from osfcore.world.collect_images import CollectTable, collect_table

        last = last_of(collect_table(options_as(CollectTable, self)))
        return {"out": str(self.out), "images": last.total}


@dataclass(frozen=True)
class CollectPushesCommand(DataCommand):
    """Episodes of pushes for learning dynamics. A killed collection goes on where it was when started again."""

    out: Path
    """HDF5 file to write; must be new."""
    episodes: int = 1000
    """Number of episodes."""
    steps: int = 50
    """Actions of 0.2 s per episode."""
    objects: int = 3
    """Objects per scene, chosen at random among those fetched."""
    policy: Literal["paper", "directed"] = "paper"
    """Uniform random velocities, or a pusher that seeks sustained contact."""
    seed: int = 0
    """Of everything."""
    images: bool = False
    """Keep frames of one camera as well, with the pusher in them."""
    camera: Literal["0", "goal"] = "0"
    """What takes the frames: camera 0, or the one that takes goal images."""
    size: int = 128
    """Side of the frames [px]."""
    random_lights: bool = False
    """Frames under one light per episode from the whole hemisphere."""
    renderer: Literal["embree", "tiny"] = "embree"
    """What takes the frames: exact ray tracing, or PyBullet's TinyRenderer."""
    simulator: Literal["pybullet", "mujoco"] | None = None
    """What moves the objects; PyBullet where it is installed, else MuJoCo."""
    names: tuple[str, ...] | None = None
    """Objects to choose from; by default all that were fetched."""
    disturb: int = 0
    """From how many slightly disturbed states to simulate each quarter of an action in which something moves."""
    workers: int = 2
    """Processes that simulate side by side; the content does not depend on it."""
    cluster: str | None = None
    """Address of a Dask scheduler whose workers simulate instead, or slurm, or slurm:partition=gpu,time=60: a job of
    SLURM for each episode. They need the same data folder."""

    def run(self) -> dict[str, Any]:
        """Collect; the result has the shares of steps with contact and motion, and the rate."""
        from osfcore.world.collect_pushes import CollectPushes, collect_pushes

        in_flight = self.workers + 2 if self.cluster is None else _IN_FLIGHT
        with worker_pool(self.workers, self.cluster) as executor:
            last = last_of(collect_pushes(options_as(CollectPushes, self), self.assets, executor, in_flight))
        shares = {"contact_share": round(last.contact_share, 4), "motion_share": round(last.motion_share, 4)}
        rate = round(last.episodes_per_s, 2)
        return {
            "out": str(self.out), "episodes": self.episodes, "steps": self.steps, **shares, "episodes_per_s": rate,
        }  # fmt: skip


@dataclass(frozen=True)
class CollectObservationCommand(DataCommand):
    """One observation of a random scene, to try 'osf estimate' with; truth.json in it has what was there."""

    out: Path
    """Folder to write; must be new or empty."""
    names: tuple[str, ...] | None = None
    """Names of the objects; by default a random choice among those with a field."""
    objects: int = 3
    """How many objects, where no names are given."""
    seed: int = 0
    """Of objects, places and light."""
    size: int = 128
    """Side of the square images [px]."""
    goal: bool = False
    """Only the goal camera's view, without pusher and masks."""

    def run(self) -> dict[str, Any]:
        """Collect; the result names the folder and what is to be seen."""
        from osfcore.world.collect_images import CollectObservation, collect_observation

        made = collect_observation(options_as(CollectObservation, self), self.assets, self.trained.names())
        views = "1 view" if len(made.cameras) == 1 else f"{len(made.cameras)} views"
        self.say(f"Wrote {self.out}: {views} of {', '.join(made.names)}.")
        return {"out": str(self.out), "objects": list(made.names), "cameras": [c.name for c in made.cameras]}


Collect = choice_of(
    object=CollectObjectCommand,
    table=CollectTableCommand,
    pushes=CollectPushesCommand,
    observation=CollectObservationCommand,
)
