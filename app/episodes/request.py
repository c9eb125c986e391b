"""Episodes in the simulator, without the service: what is asked for, the world and goal that this means, the run."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from osfcore.control.closed_loop import Episode
from osfcore.control.estimators import ESTIMATOR, ESTIMATORS, EpisodeParts, load_scene_models
from osfcore.control.events import EpisodeSettings, Event
from osfcore.control.goal import GoalImage
from osfcore.control.world import SimulatedWorld
from osfcore.errors import CorruptFile, InvalidInput, OsfError
from osfcore.fields.devices import use_one_thread
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, Camera, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.states import SceneState, shifted_poses
from osfcore.io.files import read_json, reading_png
from osfcore.io.json_codec import decode
from osfcore.objects.asset_library import AssetLibrary
from osfcore.photo.found_scene import FoundScene
from osfcore.photo.table_layout import TableLayout, layout_of
from osfcore.planning.costs import PoseGoal
from osfcore.planning.parts import COST, COSTS, PLANNER, PLANNERS
from osfcore.plugins import part_factory
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.scenes import SceneRequest
from osfcore.world.simulators import Simulator, default_simulator
from osfcore.world.tabletop import WORLD, WORLDS, Tabletop, WorldInputs
from osfcore.world.tasks import arranged_goal, random_goal

from .file_names import RECORDING_FILE
from .progress import EpisodeProgress
from .record import About, EpisodeRecord, PartNames, recorded

_MODES = ("L", "LA", "P", "RGB", "RGBA")  # Pillow's, of 8 bits a channel: others would be clipped silently


@dataclass(frozen=True, slots=True)
class EpisodeOrder:
    """An episode in the simulator.

    Attributes:
        out: folder for its results.
        data_dir: where objects, and fields and networks trained on this machine, are.
        names: the objects; None for a random choice.
        objects: how many, where names are not given.
        seed: of the scene, its light, a random goal, and the searches.
        goal: PNG of how the table should look, from the goal camera; None for a random goal.
        found: JSON of what was found in a photograph, instead: objects shall lie as there, and begin elsewhere.
        moved: how many objects a random goal moves; as the seed will have it if None.
        light: on the table; as the seed will have it if None.
        shifts_m: instead of a random goal: objects that lie elsewhere in it, and how far along x and y.
        goal_light: in the goal's image; that of the table if None.
        goal_side: of that image [px].
        settings: how it goes.
        device: that computes.
        parts: that it is made of.
        simulator: what moves the objects of our own worlds; None for PyBullet where it is installed, else MuJoCo.
    """

    out: Path
    data_dir: Path
    names: tuple[str, ...] | None = None
    objects: int = 3
    seed: int = 0
    goal: Path | None = None
    found: Path | None = None
    moved: int | None = None
    light: Light | None = None
    shifts_m: Mapping[str, tuple[float, float]] | None = None
    goal_light: Light | None = None
    goal_side: int = DEFAULT_IMAGE_SIDE
    settings: EpisodeSettings = field(default_factory=EpisodeSettings)
    device: str = "cpu"
    parts: PartNames = field(default_factory=PartNames)
    simulator: Simulator | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Given:
    """What an episode begins with.

    Attributes:
        world: with the scene on the table.
        goal: the image, or poses.
        truth: how the table truly should be, where that is known.
        moved: objects that truly should move, where that is known.
    """

    world: SimulatedWorld
    goal: GoalImage | PoseGoal
    truth: SceneState | None
    moved: tuple[str, ...]


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedTable:
    """A simulated table as reports see it.

    Attributes:
        world: the simulation.
    """

    world: SimulatedWorld

    def truth(self) -> SceneState:
        """Where everything truly is."""
        return self.world.truth()

    def photo(self, camera: Camera) -> Float[np.ndarray, "h w 3"]:
        """What a camera sees, the pusher included."""
        return self.world.render((camera,)).images[0]


def given(order: EpisodeOrder) -> Given:
    """Set the table and take or draw the goal.

    Raises:
        OsfError: if the objects, the image or the numbers are not as they must be.
    """
    assets, fields = AssetLibrary(order.data_dir / "objects"), FieldLibrary(order.data_dir)
    layout = None if order.found is None else _layout(order, order.found)
    names = order.names if layout is None else tuple(layout.poses)
    for name in names or ():
        fields.info(name)
    among = tuple(name for name in fields.names() if assets.has(name))
    make = part_factory(WORLD, order.parts.world, WORLDS)
    simulator = order.simulator or default_simulator()
    world = make(WorldInputs(assets, SceneRequest(names, order.objects, order.light, among), simulator))
    try:
        if not isinstance(world, Tabletop):
            return _given_by_image(order, world)
        return _begun(order, world) if layout is None else _photographed(order, layout, world)
    except BaseException:
        world.close()
        raise


def _given_by_image(order: EpisodeOrder, world: SimulatedWorld) -> Given:
    """A world that only looks and pushes: goals are drawn and arranged on a `Tabletop` alone."""
    if order.goal is None:
        allowed = "one that derives from Tabletop, or given a goal image: only on a Tabletop can goals be arranged"
        raise InvalidInput("world", order.parts.world, allowed)
    world.reset(order.seed)
    return Given(world, read_goal(order.goal, goal_camera()), None, ())


def _layout(order: EpisodeOrder, path: Path) -> TableLayout:
    found = read_json(path, lambda data: decode(FoundScene, data, "found objects"))
    for what, given in (("goal image", order.goal), ("names of objects", order.names)):
        if given is not None:
            allowed = "left out with what was found in a photo, which has goal and objects"
            raise InvalidInput(what, str(given), allowed)
    doubts = [each.doubt for each in found.objects if each.doubt]
    if doubts and not order.settings.despite_doubts:
        raise OsfError(f"{' '.join(doubts)} Look at its picture, and say --despite-doubts to go on all the same.")
    return layout_of(found)


def _photographed(order: EpisodeOrder, layout: TableLayout, world: Tabletop) -> Given:
    """The goal is the layout at rest; the table is a random one in which the objects lie on the same sides."""
    world.arrange(order.seed)
    world.set_light(order.light or layout.light)
    goal = replace(arranged_goal(world, layout.poses, is_measured=True), pusher=None)
    _, moved = random_goal(world, order.seed, order.moved)
    return Given(world, PoseGoal(goal.names, goal.poses), goal, moved)


def _begun(order: EpisodeOrder, world: Tabletop) -> Given:
    world.arrange(order.seed)
    if order.goal is not None:
        goal = read_goal(order.goal, goal_camera())
        if order.moved is not None:
            raise InvalidInput("number of objects that move", order.moved, "left out with a goal image, which shows it")
        return Given(world, goal, None, ())
    start, camera = world.truth(), goal_camera(order.goal_side)
    if order.shifts_m is None:
        task = random_goal(world, order.seed, order.moved)
    else:
        arranged = arranged_goal(world, shifted_poses(start, order.shifts_m))
        task = replace(arranged, pusher=None), tuple(order.shifts_m)
    if order.goal_light is not None:
        world.set_light(order.goal_light)
    image = world.render((camera,), with_pusher=False).images[0]
    world.restore(start)
    return Given(world, GoalImage(camera, image), *task)


def read_goal(path: Path, camera: Camera) -> GoalImage:
    """A goal image from a file, seen by the camera at whatever size the image has.

    Raises:
        CorruptFile: if it is no PNG.
        InvalidInput: if its sides are not in the proportion of the camera's, or out of range.
    """
    if not path.is_file():
        raise CorruptFile(path, "there is no such file")
    with reading_png(path, "it is no readable PNG image"), Image.open(path, formats=("PNG",)) as image:
        width, height = image.size  # from the header: nothing is decoded yet
        if width * camera.height != height * camera.width:
            allowed = f"in proportion {camera.width}:{camera.height}, as the goal camera sees"
            raise InvalidInput(f"size of {path.name} [px]", f"{width} x {height}", allowed)
        resized = camera.resized(width, height)
        if image.mode not in _MODES:
            raise CorruptFile(path, "it is no image of 8 bits a channel")
        return GoalImage(resized, np.asarray(image.convert("RGB"), np.float32) / 255)


def parts_of(names: PartNames, data_dir: Path) -> EpisodeParts:
    """What estimates, plans and compares.

    Args:
        names: of the parts.
        data_dir: from which estimators are made.

    Raises:
        UnknownName: if there is no part of a name.
        BrokenPlugin: if another package's cannot be used.
    """
    cost = None if names.cost is None else part_factory(COST, names.cost, COSTS)
    estimators = part_factory(ESTIMATOR, names.estimator, ESTIMATORS)(data_dir)
    return EpisodeParts(estimators, part_factory(PLANNER, names.planner, PLANNERS), cost)


@dataclass(frozen=True, eq=False, slots=True)
class EpisodeStep(EpisodeProgress):
    """How far an episode is.

    Attributes:
        event: what just happened, if anything did.
        report: with the last step only.
    """

    event: Event | None = None
    report: dict[str, Any] | None = None


def run_episode(order: EpisodeOrder) -> Iterator[EpisodeStep]:
    """Run an episode; the last step brings the report, and the folder holds everything.

    Raises:
        OsfError: if the order cannot be met, or the disk refuses.
    """
    from .recording import write_recording

    step = EpisodeStep(0, order.settings.steps, "Loading fields and setting the table")
    yield step
    use_one_thread()
    parts, begin = parts_of(order.parts, order.data_dir), given(order)
    try:
        assets = AssetLibrary(order.data_dir / "objects")
        names = begin.world.truth().names
        models = load_scene_models(names, FieldLibrary(order.data_dir), assets, order.data_dir, order.device)
        symmetries = {name: assets.info(name).symmetry for name in names}
        simulator = (order.simulator or default_simulator()) if isinstance(begin.world, Tabletop) else None
        about = About(
            names, order.seed, order.settings, begin.truth, begin.moved, symmetries, parts=order.parts,
            simulator=simulator,
        )  # fmt: skip
        record = EpisodeRecord(order.out, SimulatedTable(begin.world), about)
        rng = stream_rng(order.seed, Stream.EPISODE)
        events = Episode(begin.world, models, begin.goal, order.settings, rng, parts=parts).run()
        with contextlib.closing(record):
            for event in recorded(events, record):
                step = replace(step.after(event), event=event)
                yield step
        yield replace(step, note="Writing video and recording", event=None)
        report = record.finish()
        write_recording(order.out / RECORDING_FILE, assets, record.states)
        yield replace(step, event=None, report=report)
    finally:
        begin.world.close()
