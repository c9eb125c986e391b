"""Zipped observation folders that people upload for estimates: unpacked, judged, and refused at once if need be."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from app.jobs.kinds.estimates import OBSERVATION, PRIOR, Mode
from osfcore.errors import CannotWrite, InvalidInput
from osfcore.io.scene_file import read_estimated

ARCHIVE = "observation.zip"


@dataclass(frozen=True, slots=True)
class Uploaded:
    """What was found in an uploaded observation.

    Attributes:
        names: of the objects.
        cameras: their names.
        has_masks: whether it tells visible pixels.
        unseen: objects whose masks are all empty.
        has_prior: whether a state of how the objects lie came with it.
    """

    names: tuple[str, ...]
    cameras: tuple[str, ...]
    has_masks: bool
    unseen: tuple[str, ...]
    has_prior: bool


def examine(folder: Path) -> Uploaded:
    """Unpack `observation.zip` of a folder to `observation` beside it and judge it, as `osf check` does.

    Raises:
        OsfError: if it is no sound observation.
    """
    from osfcore.io.archives import unpack_observation
    from osfcore.io.observation_file import read_observation

    place = unpack_observation(folder / ARCHIVE, folder / OBSERVATION)
    (folder / ARCHIVE).unlink()
    observation = read_observation(place)
    unseen = (
        ()
        if observation.masks is None
        else tuple(n for i, n in enumerate(observation.names) if not observation.masks[:, i].any())
    )
    has_prior = (place / PRIOR).is_file()
    if has_prior:
        prior = read_estimated(place / PRIOR)
        if set(prior.state.names) != set(observation.names):
            raise InvalidInput("objects of prior.json", ", ".join(prior.state.names), ", ".join(observation.names))
        try:
            (place / PRIOR).rename(folder / PRIOR)
        except OSError as error:
            raise CannotWrite(folder, error.strerror or str(error)) from error
    return Uploaded(
        observation.names, tuple(c.name for c in observation.cameras), observation.masks is not None, unseen, has_prior
    )


def names_for_people(folder: Path) -> dict[str, str]:
    """What the uploader calls the places in a folder."""
    return {
        f"{folder / ARCHIVE}": "The uploaded file",
        f"{folder / OBSERVATION}/": "",
        f"{folder / OBSERVATION}": "The uploaded observation",
    }


def check_fits(mode: Mode, uploaded: Uploaded) -> None:
    """Refuse at once what the estimator would refuse."""
    if mode == "first" and not uploaded.has_masks:
        raise InvalidInput("masks of the first frame", "missing", "given: one per camera and object")
    if mode == "first" and uploaded.unseen:
        raise InvalidInput(f"mask of {uploaded.unseen[0]}", "empty in every view", "not empty in at least one view")
    if mode == "goal" and len(uploaded.cameras) != 1:
        raise InvalidInput("number of views of a goal", len(uploaded.cameras), "1")
