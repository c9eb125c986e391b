"""Runs an episode in the simulator, from an order to a folder of results, step by step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from app.episodes.event_notes import note_of
from app.episodes.file_names import RECORDING_FILE
from app.episodes.part_names import parts_of
from app.episodes.record import About, EpisodeRecord
from app.episodes.request import EpisodeOrder, SimulatedTable, given
from osfcore.control.closed_loop import Episode
from osfcore.control.estimators import load_scene_models
from osfcore.control.events import ActionExecuted, Event, Stepped
from osfcore.fields.field_library import FieldLibrary
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng


@dataclass(frozen=True, eq=False, slots=True)
class EpisodeStep:
    """How far an episode is.

    Attributes:
        done: actions executed.
        total: actions at most, as known so far.
        note: what is being done.
        event: what just happened, if anything did.
        report: with the last step only.
    """

    done: int
    total: int
    note: str
    event: Event | None = None
    report: dict[str, Any] | None = None


def run_episode(order: EpisodeOrder) -> Iterator[EpisodeStep]:
    """Run an episode; the last step brings the report, and the folder holds everything.

    Raises:
        OsfError: if the order cannot be met, or the disk refuses.
    """
    from app.episodes.recording import write_recording

    total = order.settings.steps
    yield EpisodeStep(0, total, "Loading fields and setting the table")
    parts, begin = parts_of(order.parts, order.data_dir), given(order)
    try:
        assets = AssetLibrary(order.data_dir / "objects")
        names = begin.world.truth().names
        models = load_scene_models(names, FieldLibrary(order.data_dir), assets, order.data_dir, order.device)
        symmetries = {name: assets.info(name).symmetry for name in names}
        about = About(order.seed, order.settings, begin.truth, begin.moved, symmetries, parts=order.parts)
        record = EpisodeRecord(order.out, SimulatedTable(begin.world), about)
        rng = stream_rng(order.seed, Stream.EPISODE)
        done, note = 0, ""
        for event in Episode(begin.world, models, begin.goal, order.settings, rng, parts=parts).run():
            record.take(event)
            done = event.number if isinstance(event, ActionExecuted) else done
            total = event.steps if isinstance(event, Stepped) else total
            note = note_of(event) or note
            yield EpisodeStep(done, total, note, event)
        yield EpisodeStep(done, total, "Writing video and recording")
        report = record.finish()
        write_recording(order.out / RECORDING_FILE, assets, record.states)
        yield EpisodeStep(done, total, str(report["text"]), report=report)
    finally:
        begin.world.close()
