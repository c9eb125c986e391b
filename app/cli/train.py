"""`osf train`: fields from image sets, dynamics from pushes, and a rival that predicts video."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from osfcore.errors import InvalidInput
from osfcore.io.output_paths import SUFFIX

from .command import Command, DataCommand, Device, Seed, choice_of, follow, options_as
from .workers import worker_pool

if TYPE_CHECKING:
    from osfcore.fields.train_osf import FieldSettings
    from osfcore.fields.train_several import TrainOne
    from osfcore.progress import Progress


@dataclass(frozen=True)
class TrainFieldCommand(Command):
    """Fields of objects from image sets in the OSF format. A killed training goes on when started again."""

    data: tuple[Path, ...]
    """Folder with train/anno.json and test/anno.json; several such folders for as many objects."""
    out: Path
    """File to write, such as 006_mustard_bottle.safetensors; its metrics go beside it as .json. Of several sets: a
    folder for files that are named after those of the sets."""
    minutes: float = 30.0
    """How long to train each [min]."""
    device: Device = "auto"
    seed: Seed = 0
    hollow: bool = False
    """The object has hollows that no silhouette shows, such as a bowl's."""
    iterations: int | None = None
    """Instead of a time budget: that many steps of descent, repeatable on one machine."""
    method: Literal["ours", "paper", "nerf"] = "ours"
    """What is trained: our field; a KiloOSF as published, tiny networks alone over a teacher; ours without light."""
    recipe: Literal["direct", "distil"] = "direct"
    """Of ours: direct learns from the images at once; distil, the paper's way, goes over a teacher and is slower."""
    teacher_width: int = 64
    """Units of each layer of the teacher."""
    teacher_depth: int = 4
    """Layers of the teacher."""
    workers: int = 1
    """Processes that train several objects side by side, each in its share of the threads."""
    cluster: str | None = None
    """Address of a Dask scheduler whose workers train instead, or slurm, or slurm:partition=gpu,time=60: a job of SLURM
    for each object. They need the same image sets at the same place."""

    def run(self) -> dict[str, Any]:
        """Train with a progress bar; the result has PSNR [dB] on the test images, size and time."""
        places = self._places()
        settings, train = self._paper(places) if self.method == "paper" else self._ours(places)
        workers = min(self.workers, len(places))
        with worker_pool(workers, self.cluster) as executor:
            if len(places) == 1 and executor is None:
                follow(train(settings[0]))
            else:
                from torch import get_num_threads

                from osfcore.fields.train_several import train_several

                shares_disk = self.cluster is None
                threads = max(1, get_num_threads() // workers) if shares_disk else 1
                follow(train_several(settings, train, executor, threads=threads, shares_disk=shares_disk))
        found = {}
        for _, out in places:
            found[out.stem] = metrics = _metrics(out)
            full, mask = metrics["psnr_full"], metrics["psnr_mask"]
            quality = f"{full:.1f} dB on unseen views and lights, {mask:.1f} dB in the mask"
            self.say(f"Wrote {out}: {quality}, {metrics['bytes'] / 1e6:.2f} MB.")
        return {"out": str(self.out), **(found[self.out.stem] if len(places) == 1 else {"fields": found})}

    def _places(self) -> list[tuple[Path, Path]]:
        """Each image set with the file to write."""
        if len(self.data) == 1:
            return [(self.data[0], self.out)]
        names = [data.absolute().name for data in self.data]
        if not names or len(set(names)) < len(names):
            allowed = "one folder or more, no two of one name, which becomes that of the field"
            raise InvalidInput("choice of image sets", ", ".join(names) or "none", allowed)
        if self.out.suffix == SUFFIX:
            raise InvalidInput("output of several image sets", self.out, "a folder")
        return [(data, self.out / f"{name}{SUFFIX}") for data, name in zip(self.data, names, strict=True)]

    def _ours(self, places: Sequence[tuple[Path, Path]]) -> tuple[Sequence[FieldSettings], TrainOne]:
        from osfcore.fields.train_kiloosf import TrainField, train_field

        lit = self.method != "nerf"
        return [options_as(TrainField, self, data=data, out=out, lit=lit) for data, out in places], train_field

    def _paper(self, places: Sequence[tuple[Path, Path]]) -> tuple[Sequence[FieldSettings], TrainOne]:
        from osfcore.fields.train_osf import FieldSettings
        from osfcore.paper.train_fields import train_paper_field

        _refuse("with --method paper, which has no such thing", hollow=self.hollow, recipe=self.recipe != "direct")
        return [options_as(FieldSettings, self, data=data, out=out) for data, out in places], train_paper_field


@dataclass(frozen=True)
class TrainTableCommand(Command):
    """The table's field from an image set of the bare table."""

    data: Path
    """Folder with train/anno.json and test/anno.json, such as 'osf collect table' writes."""
    out: Path
    """File to write, such as table.safetensors; its metrics go beside it as .json."""
    device: Device = "auto"
    seed: Seed = 0

    def run(self) -> dict[str, Any]:
        """Train with a progress bar; the result holds the metrics."""
        from osfcore.fields.train_table import TrainTable, train_table

        follow(train_table(TrainTable(self.data, self.out, self.device, self.seed)))
        metrics = _metrics(self.out)
        self.say(f"Wrote {self.out}: {metrics['psnr']:.1f} dB on unseen views and lights.")
        return {"out": str(self.out), **metrics}


@dataclass(frozen=True)
class TrainDynamicsCommand(DataCommand):
    """What pushes do, from recorded ones. A killed training goes on when started again."""

    data: tuple[Path, ...]
    """Push files that 'osf collect pushes' wrote; one in twelve episodes is held out."""
    out: Path
    """File to write, such as pushes.safetensors; its metrics go beside it as .json."""
    method: Literal["ours", "paper"] = "ours"
    """What is trained: our model, or the paper's as published, on windows of three actions alone."""
    iterations: int | None = None
    """Steps of descent at most: of ours on single substeps (default 26000), of the paper's (default 2000)."""
    long_iterations: int | None = None
    """Of ours: steps of descent on windows of three actions, after these (default 500)."""
    patience: int | None = None
    """Measurements on held-out episodes without a better one after which training stops (ours 20, paper 12)."""
    without: tuple[str, ...] = ()
    """Of ours: objects whose episodes are left out."""
    hidden: int | None = None
    """Width of the network (ours 192, paper 128)."""
    batch: int | None = None
    """Substeps, or windows of the paper's, in each step of descent (ours 512, paper 256)."""
    long_batch: int | None = None
    """Of ours: windows in each (default 96)."""
    rate: float | None = None
    """Of learning, at its highest (ours 0.004, paper 0.001)."""
    propagations: int | None = None
    """Of the paper's: steps of propagation (default 3)."""
    weight_decay: float | None = None
    """Of the paper's: decay of weights by AdamW (default 0.5)."""
    device: Device = "auto"
    seed: Seed = 0

    def run(self) -> dict[str, Any]:
        """Train with a progress bar; the result holds the metrics."""
        follow(self._train_paper() if self.method == "paper" else self._train_ours())
        metrics = _metrics(self.out)
        mm, deg = metrics["validation_mm_4"], metrics["validation_deg_4"]
        self.say(f"Wrote {self.out}: held out, {mm:.1f} mm and {deg:.1f} deg after 4 steps.")
        return {"out": str(self.out), **metrics}

    def _train_ours(self) -> Iterator[Progress]:
        from osfcore.dynamics.rollout import load_shapes
        from osfcore.dynamics.train import TrainDynamics, train_dynamics

        _refuse(
            "without --method paper",
            propagations=self.propagations is not None,
            weight_decay=self.weight_decay is not None,
        )
        config = options_as(TrainDynamics, self)
        return train_dynamics(config, load_shapes(self.data_dir, self.trained, self.trained.names()))

    def _train_paper(self) -> Iterator[Progress]:
        from osfcore.paper.dynamics import longest_axes
        from osfcore.paper.train_dynamics import TrainPaperDynamics, train_paper_dynamics

        _refuse(
            "with --method paper, which has no such thing",
            long_iterations=self.long_iterations is not None,
            long_batch=self.long_batch is not None,
            without=bool(self.without),
        )
        config = options_as(TrainPaperDynamics, self)
        return train_paper_dynamics(config, longest_axes(self.trained, self.trained.names()))


@dataclass(frozen=True)
class TrainFitVidCommand(DataCommand):
    """FitVid, which predicts video, to compare with. A killed training goes on when started again."""

    data: tuple[Path, ...]
    """Push files with frames, as 'osf collect pushes --images --camera goal --random-lights' writes them."""
    out: Path
    """File to write, such as fitvid.safetensors; its metrics go beside it as .json."""
    minutes: float = 60.0
    """How long to train [min]."""
    iterations: int | None = None
    """Instead of a time budget: that many steps of descent, repeatable on one machine."""
    side: int | None = None
    """Of its images [px], to which recorded frames are averaged down; as they were recorded without it."""
    width: int = 4
    """Channels at full size; they double whenever the image is halved."""
    batch: int = 8
    """Windows in each step of descent."""
    frames: int = 12
    """Frames of a window, of which two are given."""
    rate: float = 2e-3
    """Of learning."""
    warm_up: int = 200
    """Steps over which the rate rises from nothing."""
    beta: float = 1e-4
    """Weight of the KL divergence."""
    decoded: int = 4
    """Frames of each window that are drawn in a step."""
    augment: bool = True
    """Vary colours."""
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    """What convolutions compute in while training."""
    save_every: int = 20
    """Steps between checkpoints."""
    measured: int = 32
    """Held-out videos to measure on in the end, at most."""
    device: Device = "auto"
    seed: Seed = 0

    def run(self) -> dict[str, Any]:
        """Train with a progress bar; the result holds the metrics."""
        from osfcore.experiments.rivals.train_fitvid import TrainFitVid, train_fitvid

        follow(train_fitvid(options_as(TrainFitVid, self), self.assets))
        metrics = _metrics(self.out)
        for horizon, means in metrics["horizons"].items():
            psnr = f"{means['psnr']:.1f} dB (the last known frame, copied: {means['psnr_copied']:.1f} dB)"
            self.say(f"Wrote {self.out}: held out, over {horizon} steps, {psnr}.")
        return {"out": str(self.out), **metrics}


def _refuse(when: str, **given: bool) -> None:
    """Refuse options that were given but mean nothing then, such as "with --method paper"."""
    for name, is_given in given.items():
        if is_given:
            raise InvalidInput(f"option --{name.replace('_', '-')}", "given", f"left out {when}")


def _metrics(out: Path) -> dict[str, Any]:
    return json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))


Train = choice_of(
    field=TrainFieldCommand, table=TrainTableCommand, dynamics=TrainDynamicsCommand, fitvid=TrainFitVidCommand
)
