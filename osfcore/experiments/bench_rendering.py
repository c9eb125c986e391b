"""Time rendering: new scenes against TinyRenderer, planning, the reference, and how the cost grows.

All figures come from one run on one machine and belong together. Before anything is timed, compiled code is compiled
and both renderers have drawn the same objects once (TinyRenderer has read its meshes, ours has unpacked its fields);
every timed scene is new: poses, light and pusher have not been drawn before. Objects may overlap, which neither minds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, check_seed
from osfcore.experiments.harness import EvaluationStep, measurable
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, WORKSPACE_HALF_M
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.image_file import to_uint8
from osfcore.metrics.image_errors import psnr
from osfcore.objects.asset import ObjectAsset
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import EXACT, PLANNING, Quality, SceneBatch
from osfcore.world.physics import lowest_point
from osfcore.world.scenes import random_rest
from osfcore.world.tiny_renderer import TinyScene


@dataclass(frozen=True, eq=False, slots=True)
class RenderReport:
    """Costs of rendering.

    Attributes:
        figures: plain numbers, medians: one new scene by plain TinyRenderer with its shadow "tinyrenderer_ms", by us
            carefully "scene_exact_ms" and at planning quality "scene_ms" [ms], and how many times faster we are;
            images a second when planning, and their PSNR against exact ones [dB]; one such scene by the reference
            renderer "reference_ms" [ms]; the "threads" that we may use, where TinyRenderer has one; costs by number
            of objects, by side of the image and by number of scenes in one call; and "growth": how steeply these
            costs grow, where 1 is in proportion.
        shown: a scene by TinyRenderer and by us.
    """

    figures: dict[str, Any]
    shown: tuple[Comparison, ...]


def slope(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """Return the exponent p of the best fit cost ~ size^p; None with fewer than two sizes."""
    if len(sizes) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


NEW_SCENE_QUALITY: Quality = EXACT  # one ray a pixel, as TinyRenderer
OBJECTS = 3
CANDIDATES, STEPS = 64, 10
STEP_M, TURN_RAD = 0.015, 0.1  # what a push does to an object within one step
_JITTER = 0.3  # of a place on the grid, as a share of its side
_REACH_M = 0.26  # where the pusher may be


@dataclass(frozen=True, slots=True)
class BenchRender:
    """What to measure, and how often.

    Attributes:
        scenes: new scenes against TinyRenderer.
        repeats: of everything else.
        counts: numbers of objects.
        sides: of images [px].
        batches: numbers of scenes in one call.
        side: of all other images [px].
        seed: of all scenes.
    """

    scenes: int = 60
    repeats: int = 5
    counts: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12, 16)
    sides: tuple[int, ...] = (64, 96, 128, 192, 256)
    batches: tuple[int, ...] = (1, 2, 8, 32, 128, 512)
    side: int = DEFAULT_IMAGE_SIDE
    seed: int = 0


def bench_render(
    config: BenchRender, fields: FieldLibrary, assets: AssetLibrary
) -> Iterator[EvaluationStep[RenderReport]]:
    """Measure everything, one part after the other.

    Args:
        config: what to measure, and how often.
        fields: what we render.
        assets: meshes, which TinyRenderer draws.

    Raises:
        InvalidInput: if a number is out of range, or there is no field.
        MissingAssets: if no object has both a field and a mesh.
    """
    import numba

    for what, value in (("new scenes", config.scenes), ("repeats", config.repeats)):
        if value < 1:
            raise InvalidInput(f"number of {what}", value, "1 or more")
    check_seed(config.seed)
    parts = ("new scenes", "planning", "the reference", "numbers of objects", "resolutions", "batches")

    yield EvaluationStep(0, len(parts), "Compiling")
    stage = _Stage(config, fields, assets)
    measures: tuple[Callable[[], Any], ...] = (
        stage.new_scenes,
        stage.planning,
        stage.reference,
        lambda: [stage.cost(n, n, config.side, 1, NEW_SCENE_QUALITY) for n in config.counts],
        lambda: [stage.cost(side, OBJECTS, side, 1, NEW_SCENE_QUALITY) for side in config.sides],
        lambda: [stage.cost(n, OBJECTS, config.side, n, PLANNING) for n in config.batches],
    )
    found = []
    for number, (part, measure) in enumerate(zip(parts, measures, strict=True)):
        yield EvaluationStep(number, len(parts), f"Measuring {part}")
        found.append(measure())
    ((tiny_ms, exact_ms, planning_ms), shown), (renders_per_s, planning_psnr), reference_ms = found[:3]
    objects, resolution, batch = found[3:]
    figures = {
        "tinyrenderer_ms": tiny_ms,
        "scene_exact_ms": exact_ms,
        "ratio_exact": tiny_ms / exact_ms,
        "scene_ms": planning_ms,
        "ratio": tiny_ms / planning_ms,
        "planning_renders_per_s": renders_per_s,
        "planning_psnr": planning_psnr,
        "reference_ms": reference_ms,
        "threads": int(numba.get_num_threads()),
        "by_objects": objects,
        "by_resolution": resolution,
        "by_batch": batch,
        "growth": {
            "objects": slope([c["size"] for c in objects], [c["ms"] for c in objects]),
            "pixels": slope([c["size"] ** 2 for c in resolution], [c["ms"] for c in resolution]),
            "batch": slope([c["size"] for c in batch], [c["ms"] for c in batch]),
        },
    }
    yield EvaluationStep(len(parts), len(parts), "Everything is measured", RenderReport(figures, shown))


def lay_out(assets: Sequence[ObjectAsset], rng: np.random.Generator) -> Pose:
    """Return resting poses in random places of a grid over the workspace, which large objects may outgrow."""
    side = int(np.ceil(np.sqrt(len(assets))))
    pitch = 2 * WORKSPACE_HALF_M / side
    places = np.array(list(np.ndindex(side, side)))[rng.permutation(side**2)[: len(assets)]]
    xy = (places + 0.5 + rng.uniform(-_JITTER, _JITTER, places.shape)) * pitch - WORKSPACE_HALF_M
    turns = [random_rest(asset, rng) for asset in assets]
    heights = [-lowest_point(asset, turn) for asset, turn in zip(assets, turns, strict=True)]
    return Pose(np.column_stack([xy, heights]), np.array(turns))


def rollouts(
    start: Pose, light: Light, names: tuple[str, ...], rng: np.random.Generator, candidates: int, steps: int
) -> SceneBatch:
    """Return scenes as planning renders them: in each candidate one or two objects slide and turn step by step.

    Args:
        start: T_world_object of all objects [m].
        light: the same in all images.
        names: of the objects.
        rng: chooses what moves, and where to.
        candidates: sequences of actions.
        steps: of each candidate.
    """
    count = len(names)
    positions = np.tile(start.position, (candidates, steps, 1, 1))
    quaternions = np.tile(start.quaternion, (candidates, steps, 1, 1))
    for k in range(candidates):
        for mover in rng.permutation(count)[: 1 + (rng.uniform() < 0.3)]:
            angle, turn = rng.uniform(-np.pi, np.pi), rng.uniform(-TURN_RAD, TURN_RAD)
            for t in range(steps):
                positions[k, t, mover, :2] += (t + 1) * STEP_M * np.array([np.cos(angle), np.sin(angle)])
                twist = quaternion_exp(np.array([0.0, 0.0, (t + 1) * turn]))
                quaternions[k, t, mover] = quaternion_multiply(twist, start.quaternion[mover])
    scenes = candidates * steps
    lights = np.tile(light.direction, (scenes, 1))
    return SceneBatch(names, positions.reshape(scenes, count, 3), quaternions.reshape(scenes, count, 4), lights, None)


class _Stage:
    """Objects, both renderers, and the scenes that they are timed on."""

    def __init__(self, config: BenchRender, fields: FieldLibrary, assets: AssetLibrary) -> None:
        available = measurable(fields, assets)
        self._config = config
        self._rng = stream_rng(config.seed, Stream.BENCHMARK)
        count = max(OBJECTS, *config.counts)
        # Where there are too few objects, some stand there more than once: copies under names of their own.
        self._names = tuple(f"{available[i % len(available)]} {i // len(available)}" for i in range(count))
        loaded = {name: (fields.load(name), assets.load(name)) for name in available[:count]}
        both = {name: loaded[name.rpartition(" ")[0]] for name in self._names}
        self._fields = {name: field for name, (field, _) in both.items()}
        self._assets = {name: asset for name, (_, asset) in both.items()}
        self._table = fields.load_table()
        self._ours = SceneRenderer(self._fields, self._table)
        state, camera = self._scene(OBJECTS), default_cameras(config.side)[0]  # compiles code for every quality
        for quality in (NEW_SCENE_QUALITY, PLANNING):
            self._ours.render(SceneBatch.of(state), (camera,), quality=quality)
            self._ours.render(SceneBatch.of(replace(state, pusher=None)), (camera,), quality=quality)

    def new_scenes(self) -> tuple[tuple[float, float, float], tuple[Comparison, ...]]:
        """Return median times of TinyRenderer, ours and ours at planning quality [ms], and what both drew."""
        cameras = default_cameras(self._config.side)
        tiny = TinyScene({name: self._assets[name] for name in self._names[:OBJECTS]})
        times, shown = [], []
        try:
            for number in range(-1, self._config.scenes):
                state, views = self._scene(OBJECTS), (cameras[number % len(cameras)],)
                batch = SceneBatch.of(state)
                start = time.perf_counter()
                theirs = tiny.render(state, views)
                second = time.perf_counter()
                ours = self._ours.render(batch, views, quality=NEW_SCENE_QUALITY)
                third = time.perf_counter()
                self._ours.render(batch, views, quality=PLANNING)
                times.append((second - start, third - second, time.perf_counter() - third))
                if len(shown) < len(cameras):
                    pair = to_uint8(theirs[0].rgb), to_uint8(ours.rgb[0, 0])
                    shown.append(Comparison(f"camera {views[0].name}", *pair))
        finally:
            tiny.close()
        tiny_ms, ours_ms, planning_ms = (1000 * np.median(times[1:], axis=0)).tolist()  # the first warms up
        return (tiny_ms, ours_ms, planning_ms), tuple(shown)

    def planning(self) -> tuple[float, float]:
        """Return images a second for new rollouts in one call each, and PSNR of some against exact ones [dB]."""
        camera = (goal_camera(self._config.side),)
        times, quality = [], 0.0
        for number in range(self._config.repeats + 1):
            state = self._scene(OBJECTS)
            batch = rollouts(state.poses, state.light, state.names, self._rng, CANDIDATES, STEPS)
            start = time.perf_counter()
            images = self._ours.render(batch, camera, quality=PLANNING).rgb
            times.append(time.perf_counter() - start)
            if number == 0:
                chosen = np.arange(0, CANDIDATES * STEPS, CANDIDATES)
                some = replace(
                    batch,
                    positions=batch.positions[chosen],
                    quaternions=batch.quaternions[chosen],
                    lights=batch.lights[chosen],
                )
                exact = self._ours.render(some, camera, quality=EXACT).rgb
                pairs = zip(exact[:, 0], images[chosen, 0], strict=True)
                quality = float(np.mean([psnr(a, b) for a, b in pairs]))
        return CANDIDATES * STEPS / float(np.median(times[1:])), quality  # the first call warms up

    def reference(self) -> float:
        """Return the time of the reference renderer for one new scene [ms]."""
        from osfcore.render.reference import render_reference

        state, camera = self._scene(OBJECTS), default_cameras(self._config.side)[0]
        start = time.perf_counter()
        render_reference(self._fields, self._table, state, camera, quality=NEW_SCENE_QUALITY)
        return 1000 * (time.perf_counter() - start)

    def cost(self, size: int, count: int, side: int, scenes: int, quality: Quality) -> dict[str, float]:
        """Return the "size" that a cost is noted for, and the median time of a call "ms" and "ms_per_image" [ms].

        Args:
            size: that the cost is noted for.
            count: objects in a scene.
            side: of the images [px].
            scenes: different ones under different lights in one call.
            quality: of the images.
        """
        cameras = default_cameras(side)
        repeats = self._config.repeats if scenes > 8 else 4 * self._config.repeats
        self._ours.render(self._batch(count, 1), cameras[:1], quality=quality)  # unpacks the fields
        times = []
        for number in range(repeats):
            batch, camera = self._batch(count, scenes), cameras[number % len(cameras)]
            start = time.perf_counter()
            self._ours.render(batch, (camera,), quality=quality)
            times.append(time.perf_counter() - start)
        ms = 1000 * float(np.median(times))
        return {"size": size, "ms": ms, "ms_per_image": ms / scenes}

    def _batch(self, count: int, scenes: int) -> SceneBatch:
        parts = [self._arrangement(count) for _ in range(scenes)]
        poses, lights, pushers = zip(*parts, strict=True)
        return SceneBatch(
            self._names[:count],
            np.stack([pose.position for pose in poses]),
            np.stack([pose.quaternion for pose in poses]),
            np.stack([light.direction for light in lights]),
            np.stack(pushers),
        )

    def _scene(self, count: int) -> SceneState:
        return SceneState(self._names[:count], *self._arrangement(count))

    def _arrangement(self, count: int) -> tuple[Pose, Light, Float[np.ndarray, "3"]]:
        """Draw poses, light and pusher of a new scene."""
        poses = lay_out([self._assets[name] for name in self._names[:count]], self._rng)
        pusher = np.array([*self._rng.uniform(-_REACH_M, _REACH_M, 2), PUSHER_CENTRE_Z_M])
        return poses, Light.random(self._rng), pusher
