"""Training the table's field from images of the bare table under many lights. It takes less than a minute."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn import functional

from osfcore.errors import CorruptFile, InvalidInput, check_seed
from osfcore.fields.devices import pick_device
from osfcore.fields.rays import RayBatch, RaySource
from osfcore.fields.table import TableField, table_bytes, table_from_bytes
from osfcore.fields.train_osf import Rates, descend
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.io.files import write_atomically, write_json
from osfcore.io.image_set import ImageSet, read_splits
from osfcore.io.output_paths import check_weights_place
from osfcore.progress import Progress

_HIDDEN = 16
_GRID = 16
_RATES = Rates(2e-2, 2e-4)
_REPORT_EVERY = 50
_OWN_METRICS = ("psnr", "test_images")  # by which a file of metrics is known
_EDGE_M = 0.02  # pixels that straddle the table's edge belong to nobody


@dataclass(frozen=True, slots=True)
class TrainTable:
    """Settings of the training of a table's field.

    Attributes:
        data: image set of the bare table, with `train` to learn from and `test` to measure on.
        out: file to write, FILE.safetensors. Metrics go beside it to FILE.json.
        device: "auto", "cpu" or "cuda".
        seed: seed of everything random.
        iterations: steps of descent.
        rays: pixels per step.
    """

    data: Path
    out: Path
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0
    iterations: int = 3000
    rays: int = 8192


class _Model(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.albedo = nn.Parameter(torch.full((_GRID, _GRID, 3), 0.5))
        self.ambient = nn.Parameter(torch.full((3,), 0.25))
        self.background = nn.Parameter(torch.full((3,), 0.25))
        self.first, self.second = nn.Linear(3, _HIDDEN), nn.Linear(_HIDDEN, 3)
        nn.init.constant_(self.second.bias, 0.5)

    def forward(self, places: Float[Tensor, "R 2"], lights: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
        grid = self.albedo.permute(2, 1, 0)[None]  # rows of an image run along y
        albedo = functional.grid_sample(grid, places[None, None] / (TABLE_SIDE_M / 2), align_corners=True)[0, :, 0].T
        gain = torch.relu(self.second(torch.relu(self.first(lights))))
        return albedo * (self.ambient + lights[:, 2:] * gain)

    def to_field(self) -> TableField:
        def array(tensor: Tensor) -> np.ndarray:
            return np.ascontiguousarray(tensor.detach().cpu().numpy(), np.float32)

        first, second = self.first, self.second
        weights = {"w1": first.weight.T, "b1": first.bias, "w2": second.weight.T, "b2": second.bias}
        own = {"albedo": self.albedo, "ambient": self.ambient, "background": self.background}
        return TableField(TABLE_SIDE_M / 2, **{name: array(tensor) for name, tensor in {**weights, **own}.items()})


def train_table(config: TrainTable) -> Iterator[Progress]:
    """Train a table from an image set and write it.

    Raises:
        InvalidInput: if a number is out of range, there is no GPU for "cuda", the output file has another suffix, or
            another program's file lies in place of the metrics.
        CorruptFile: if the image set is damaged or shows an object.
        CannotWrite: if the output cannot be written, which is checked first.
    """
    device = pick_device(config.device)
    check_seed(config.seed)
    for what, number in (("iterations", config.iterations), ("rays", config.rays)):
        if not 1 <= number <= 10_000_000:
            raise InvalidInput(what, number, "between 1 and 10,000,000")
    check_weights_place(config.out, _OWN_METRICS)
    yield Progress(0, config.iterations, "Reading the images")
    train, test = read_splits(config.data)
    if not train.is_opaque:
        raise CorruptFile(config.data, "its images have transparent parts; the bare table is opaque")
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    model = _Model().to(device)
    optimiser = torch.optim.Adam(model.parameters(), fused=True)
    source, pixels, half = RaySource(train), train.rgba[..., 0].size, TABLE_SIDE_M / 2
    for done in range(config.iterations):
        rays = source.batch(rng.integers(pixels, size=config.rays))
        where, reach = _meet_plane(rays)
        ends = where, rays.lights, rays.rgb, reach < half - _EDGE_M, reach > half + _EDGE_M
        places, lights, truth, on_table, beyond = (torch.as_tensor(a, device=device) for a in ends)
        loss = functional.mse_loss(model(places[on_table], lights[on_table]), truth[on_table])
        if beyond.any():
            loss = loss + functional.mse_loss(model.background.expand(int(beyond.sum()), 3), truth[beyond])
        found = descend(optimiser, loss, _RATES.at(done / config.iterations))
        if done % _REPORT_EVERY == 0:
            yield Progress(done, config.iterations, f"{-10 * np.log10(found + 1e-10):.1f} dB on its own images")
    data = table_bytes(model.to_field())
    psnr = _measure(table_from_bytes(data, "The trained table"), test)
    metrics = {"psnr": round(psnr, 3), "test_images": len(test.cameras), "train_images": len(train.cameras),
               "bytes": len(data), "iterations": config.iterations, "seed": config.seed, "device": str(device),
               "data": config.data.name}  # fmt: skip
    write_atomically(config.out, data)
    write_json(config.out.with_suffix(".json"), metrics)
    words = f"{psnr:.2f} dB held out, {len(data) / 1000:.0f} kB"
    yield Progress(config.iterations, config.iterations, words)


def _meet_plane(rays: RayBatch) -> tuple[Float32[np.ndarray, "R 2"], Float32[np.ndarray, "R"]]:
    """Return where rays meet z = 0 [m], and the larger of |x| and |y| there; infinite for rays that do not."""
    down = rays.directions[:, 2] < -1e-6
    distance = np.where(down, -rays.origins[:, 2] / np.where(down, rays.directions[:, 2], 1), 0)
    places = (rays.origins + distance[:, None] * rays.directions)[:, :2].astype(np.float32)
    return places, np.where(down, np.abs(places).max(axis=1), np.inf).astype(np.float32)


def _measure(table: TableField, test: ImageSet) -> float:
    """Return the mean PSNR over whole held-out images, with the pixels that straddle the edge [dB]."""
    source = RaySource(test)
    values = []
    for number in range(len(test.cameras)):
        rays = source.batch(source.image_pixels(number))
        places, reach = _meet_plane(rays)
        seen = reach < table.half_side
        colour = np.broadcast_to(table.background, rays.rgb.shape).copy()
        grid = (places[seen] / table.half_side + 1) / 2 * (len(table.albedo) - 1)
        colour[seen] = _bilinear(table.albedo, grid) * (table.ambient + table.direct(rays.lights[:1]))
        values.append(-10 * np.log10(float(np.mean((np.clip(colour, 0, 1) - rays.rgb) ** 2)) + 1e-10))
    return float(np.mean(values))


def _bilinear(grid: np.ndarray, places: Float[np.ndarray, "R 2"]) -> Float[np.ndarray, "R 3"]:
    whole = np.clip(np.floor(places), 0, len(grid) - 2).astype(int)
    f = (places - whole)[..., None]
    i, j = whole.T
    low = grid[i, j] * (1 - f[:, 1]) + grid[i, j + 1] * f[:, 1]
    high = grid[i + 1, j] * (1 - f[:, 1]) + grid[i + 1, j + 1] * f[:, 1]
    return low * (1 - f[:, 0]) + high * f[:, 0]
