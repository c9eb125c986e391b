"""Episodes of pushes as the goal camera sees them, and how each method predicts them.

Methods:
    copied  what is seen now stays as it is.
    ours    poses and light are estimated in one look of four cameras with masks, pushes are predicted by our dynamics,
            and each step is rendered through our fields.
    paper   the same as published: estimation, dynamics and fields.
    nerf    ours with fields that know of no light, so that none is estimated.
    fitvid  video prediction from two frames of the goal camera, at the look and one action before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from osfcore.control.estimators import Estimators
from osfcore.control.scene_models import SceneModels, load_scene_models
from osfcore.experiments.estimation.tasks import episode, first_frame, take_frame
from osfcore.experiments.fields.composite_scenes import SCENE_QUALITY
from osfcore.experiments.rivals.fitvid.weights import fitvid_path, read_fitvid
from osfcore.experiments.rivals.nerf import with_nerfs
from osfcore.experiments.task_cache import TaskResult
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.states import Observation
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.image_file import to_uint8
from osfcore.metrics.image_errors import psnr, ssim
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.stages import STAGES, PaperEstimators, with_paper_stages
from osfcore.random_streams import Stream, stream_rng
from osfcore.render.types import SceneBatch
from osfcore.world.random_scenes import Draw, opened

VIDEO_METHODS = ("copied", "ours", "paper", "nerf", "fitvid")
MEASURES = ("mse", "psnr", "ssim")
_SHOWN_STEPS = (1, 10, 20, 30)


@dataclass(frozen=True, eq=False, slots=True)
class VideoEpisode:
    """T actions that are known in advance, and what is seen.

    Attributes:
        context: frames of the goal camera, one action before the look and at it.
        between: the action between the two [m/s].
        look: four cameras with masks, for methods that estimate.
        actions: after the look [m/s].
        frames: of the goal camera after each of them, with the pusher.
    """

    context: Float[np.ndarray, "2 h w 3"]
    between: Float[np.ndarray, "3"]
    look: Observation
    actions: Float[np.ndarray, "T 3"]
    frames: Float[np.ndarray, "T h w 3"]


def simulate_video(draw: Draw, library: AssetLibrary, steps: int, size: int) -> VideoEpisode:
    """Pushes that move some object by 5 cm or more, and one action before them.

    Args:
        draw: the scene that it begins with.
        library: meshes of its objects.
        steps: actions that are predicted.
        size: side of the frames [px].

    Raises:
        UnknownName, MissingAssets: if an object has no mesh here.
        NoRoom: if the objects do not fit side by side.
    """
    camera = (goal_camera(size),)
    before = first_frame(draw, library, camera)
    pushes = episode(draw, library, camera, steps=steps + 1)
    with opened(draw, library) as world:
        world.restore(pushes.frames[0].truth)
        look = take_frame(world, default_cameras(), masks=True).observation
    frames = [frame.observation.images[0] for frame in (before, *pushes.frames)]
    return VideoEpisode(np.stack(frames[:2]), pushes.actions[0], look, pushes.actions[1:], np.stack(frames[2:]))


@dataclass(frozen=True, eq=False, slots=True)
class VideoEpisodes:
    """Measures single episodes; can be sent to other processes.

    Attributes:
        fields: ours, and the table.
        assets: meshes for the simulator.
        data_dir: where networks and fields of other methods may be.
        seed: of the estimates.
        steps: actions that are predicted.
        size: side of the frames [px].
    """

    fields: FieldLibrary
    assets: AssetLibrary
    data_dir: Path
    seed: int
    steps: int
    size: int

    def measure(self, number: int, draw: Draw, method: str) -> TaskResult:
        """An episode as a method predicts it.

        Args:
            number: of the episode.
            draw: the scene that it begins with.
            method: one of `VIDEO_METHODS`.

        Returns:
            For each measure a figure for each step; comparisons after 1, 10, 20 and 30 actions.

        Raises:
            NoRoom: if the objects do not fit side by side.
            UnknownName, CorruptFile: as fields and networks are.
        """
        video = simulate_video(draw, self.assets, self.steps, self.size)
        predicted = self._predicted(number, video, method)
        pairs = list(zip(video.frames, predicted, strict=True))
        figures = {
            "mse": [float(np.mean((true.astype(float) - image) ** 2)) for true, image in pairs],
            "psnr": [psnr(true, image) for true, image in pairs],
            "ssim": [ssim(true, image) for true, image in pairs],
        }
        shown = tuple(
            Comparison(f"step {step}", *(to_uint8(image) for image in pairs[step - 1]))
            for step in _SHOWN_STEPS
            if step <= self.steps
        )
        return TaskResult(figures, shown)

    def _predicted(self, number: int, video: VideoEpisode, method: str) -> Float[np.ndarray, "T h w 3"]:
        match method:
            case "copied":
                return np.broadcast_to(video.context[1], video.frames.shape)
            case "fitvid":
                network = read_fitvid(fitvid_path(self.data_dir))
                return network.predict(video.context, video.actions[None], between=video.between)[0]
            case _:
                models, estimators = self._models(method, video.look.names)
                rng = stream_rng(self.seed, Stream.VIDEO_ESTIMATE, number)
                return predict_through_fields(video, models, estimators, goal_camera(self.size), rng)

    def _models(self, method: str, names: tuple[str, ...]) -> tuple[SceneModels, Estimators]:
        models = load_scene_models(names, self.fields, self.assets, self.data_dir)
        if method == "paper":
            return with_paper_stages(models, frozenset(STAGES), self.fields, self.data_dir), PaperEstimators()
        if method == "nerf":
            overhead = Light(np.array([0.0, 0.0, 1.0]))
            return with_nerfs(models, self.fields, self.data_dir), Estimators.with_known_lights(overhead, overhead)
        return models, Estimators()


def predict_through_fields(
    video: VideoEpisode, models: SceneModels, estimators: Estimators, camera: Camera, rng: np.random.Generator
) -> Float[np.ndarray, "T h w 3"]:
    """Estimate what is seen, roll it out, render each step.

    Args:
        video: of which the look and the actions play a part.
        models: fields and dynamics.
        estimators: of poses and light.
        camera: that sees the prediction.
        rng: of the estimate.
    """
    *_, last = estimators.first_frame(models.appearance, video.look, rng)
    assert last.estimate is not None, "the last step brings the estimate"
    state = last.estimate.state
    future = models.dynamics.rollout(state, video.actions[None])
    lights = np.tile(state.light.direction, (len(video.actions), 1))
    batch = SceneBatch(
        future.names, future.positions[0, 1:], future.quaternions[0, 1:], lights, future.pusher[0, 1:]
    )  # fmt: skip
    rendered = models.appearance.together.render(batch, (camera,), quality=SCENE_QUALITY)
    return np.clip(rendered.rgb[:, 0], 0, 1)
