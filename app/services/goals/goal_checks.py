"""Whether a goal can be one for a table, told within seconds and before anything starts, in words for people."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from app.processes.client import ProcessClient, ProcessUnavailable
from app.processes.messages.neural_messages import CheckPhoto
from app.processes.messages.scene_messages import SceneRecord
from app.services.fields import FieldCatalogue, MissingFields
from app.services.goals.goals import Goals, NoTable
from app.services.runner import Runner
from app.storage.records import GoalRecord
from osfcore.errors import OsfError, UnknownName
from osfcore.estimation.steps import ContentCheck, Verdict

GoalVerdict = Verdict | Literal["other table"]
_MOST_REMEMBERED = 200


@dataclass(frozen=True, slots=True)
class GoalCheck:
    """What a goal shows, compared with a table.

    Attributes:
        verdict: as `ContentCheck`; or "other table" if it is known to hold other objects.
        text: what is wrong, and what to do; empty if nothing is.
        scene: the table for which it was made, if it is another one and still there.
    """

    verdict: GoalVerdict
    text: str = ""
    scene: str | None = None

    @property
    def is_refused(self) -> bool:
        """Whether an episode with this goal makes no sense."""
        return self.verdict not in ("shown", "doubtful")


class GoalRefused(OsfError):
    """A goal that cannot be reached with the objects of the table."""


class GoalChecks:
    """Checks goals, and remembers what it has found. Methods block; any thread may call.

    Args:
        runner: knows the scenes.
        fields: what can be recognised.
        goals: goal images.
        link: to the process that looks at photos.
        labels: names of objects for people.
    """

    def __init__(
        self,
        runner: Runner,
        fields: FieldCatalogue,
        goals: Goals,
        link: ProcessClient,
        labels: Callable[[], Mapping[str, str]],
    ) -> None:
        self._runner, self._fields, self._goals, self._link, self._labels = runner, fields, goals, link, labels
        self._found: dict[object, ContentCheck] = {}
        self._one_at_a_time = threading.Lock()  # a second page that asks the same waits for the first one's answer

    def check(self, goal: str, scene: str | None = None) -> GoalCheck:
        """Compare a goal with a table, the current one if none is named.

        Raises:
            NoTable, UnknownName: if there is no such table or goal.
            MissingFields: if an object of the table cannot be recognised.
            ProcessUnavailable: if what looks at photos has died.
        """
        record = self._goals.get(goal)
        scene = scene or self._runner.current
        if scene is None:
            raise NoTable
        table = self._runner.scene(scene)
        if record.poses is not None:
            return self._made_here(record, table)
        if missing := sorted(set(table.state.names) - set(self._fields.names())):
            raise MissingFields(missing)
        found = self._content(record, table)
        return GoalCheck(found.verdict, _text(found.verdict, self._listed(table.state.names)))

    def require(self, goal: str, scene: str) -> None:
        """Refuse a goal that makes no sense for a table.

        Raises:
            GoalRefused: if so; otherwise as `check`.
        """
        try:
            check = self.check(goal, scene)
        except ProcessUnavailable:  # the episode looks at the photo itself, and refuses what it does not explain
            return
        if check.is_refused:
            raise GoalRefused(check.text)

    def _made_here(self, goal: GoalRecord, table: SceneRecord) -> GoalCheck:
        """A goal of which it is known what it holds."""
        names = tuple(name for name, _ in goal.poses or ())
        if set(names) == set(table.state.names):
            return GoalCheck("shown")
        text = f"This goal was made for another table, with {self._listed(names)}."
        try:
            home = None if goal.scene is None else self._runner.scene(goal.scene).id
        except UnknownName:
            home = None
        return GoalCheck("other table", text, home)

    def _content(self, goal: GoalRecord, table: SceneRecord) -> ContentCheck:
        with self._one_at_a_time:
            stamps = tuple(self._fields.stamp(name) for name in table.state.names)
            key = (goal.id, goal.photo, table.state.names, stamps)
            if key not in self._found:
                photo = self._goals.image(goal.id).read_bytes()
                answer = self._link.call(CheckPhoto(uuid.uuid4().hex, table.state, goal.camera, photo))
                assert isinstance(answer, ContentCheck)
                self._found[key] = answer
                while len(self._found) > _MOST_REMEMBERED:
                    self._found.pop(next(iter(self._found)))
            return self._found[key]

    def _listed(self, names: tuple[str, ...]) -> str:
        labels = self._labels()
        *others, last = [f"the {labels[name].lower()}" if name in labels else name for name in names]
        return f"{', '.join(others)} and {last}" if others else last


def _text(verdict: Verdict, objects: str) -> str:
    match verdict:
        case "shown":
            return ""
        case "doubtful":
            return f"It is not certain that this photo shows {objects}."
        case "bare":
            return f"Nothing can be seen on the table in this photo; choose one that shows {objects}."
        case "elsewhere":
            return "This photo does not show the table as the goal camera sees it; crop it, or choose another one."
        case "others":
            return f"This photo does not seem to show {objects}; choose another one, or a table with what it shows."
