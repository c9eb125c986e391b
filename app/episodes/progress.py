"""What the events of an episode mean, for a person who follows it."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

from osfcore.control.events import ActionExecuted, Event, Finished, GoalFound, Looking, Noticed, Planning, Stepped

_FOUND = {
    "first": "Knows where everything is",
    "goal": "Comparing the goal image with the table",
    "next": "Knows where everything is now",
    "search": "Knows where everything is now",
}


@dataclass(frozen=True, eq=False, slots=True)
class EpisodeProgress:
    """How far an episode is.

    Attributes:
        done: actions executed.
        total: actions at most; 0 while that is not known.
        note: what is being done, for a person.
        stage: which part of the loop is at work: "first", "goal", "plan", "act", "next" or "search"; None before it.
        outcome: how it ended; only at the end.
        text: the same in a sentence.
    """

    done: int
    total: int
    note: str
    stage: str | None = None
    outcome: str | None = None
    text: str | None = None

    def after(self, event: Event) -> Self:
        """Return how far the episode is once something has happened."""
        match event:
            case Looking():
                return replace(self, note=_note_of(event), stage=event.look)
            case GoalFound():
                return replace(self, note="Knows where everything should be")
            case Planning():
                return replace(self, note="Planning pushes", stage="plan")
            case Stepped():
                return replace(self, note="Planning pushes", stage="plan", total=event.steps)
            case ActionExecuted(number):
                return replace(self, note="Pushing", stage="act", done=number)
            case Noticed():
                return replace(self, note=event.text)
            case Finished(_, outcome, text):
                return replace(self, note=text, outcome=outcome, text=text)
            case _:
                return self


def _note_of(event: Looking) -> str:
    if event.step.estimate is not None:
        return _FOUND[event.look]
    where = {"first": "first frame", "goal": "goal image", "next": "table", "search": "lost objects"}
    return f"Looking at the {where[event.look]}: {event.step.progress.note}"


# How far an episode is and how long it will take, over all of looking, planning and pushing.


# On two cores, where nothing is known yet. Looks: medians of the episodes that the shipped stories were chosen from;
# pushes: about what those stories took.
_LOOK_S = {"first": 30.0, "goal": 25.0}
_ROUND_S = 1.0
_PUSHES = 30
_SURE = 10  # pushes from which their own rate of approach counts more than the usual one
_RECENT = 8  # pushes whose mean time is that of those to come
_LAST_SHARE = 0.1  # of the pushes so far that are still to come, at least, where more have come than usual
_CALM_S = 6.0  # in which most of a change is told


class TimeLeft:
    """The share of an episode that is over, from its events.

    A look takes a usual time, or what its steps so far predict, by the share that is over. Pushes take the mean time of
    the recent ones. How many are needed is the mean of two numbers: what is left of a usual episode, and what takes the
    offsets from the goal away at the rate so far; all that are allowed where offsets are not known. The first pushes
    only reach an object and the last ones move it by a hair, so that this changes much from one push to the next; it is
    told by and by, and what is told never rises by more than the time that has passed. A rest that ends with `go_on`
    does not count.

    Args:
        clock: returns the time [s].
        finds_goal: whether the goal image is looked at for poses.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, finds_goal: bool = True) -> None:
        self._clock, self._now = clock, clock()
        self._elapsed = 0.0  # [s], of the whole episode
        self._since: dict[str, float] = {}  # when each part began, on `_elapsed`
        self._left = {look: seconds for look, seconds in _LOOK_S.items() if finds_goal or look != "goal"}
        self._first_off_m = self._off_m = 0.0
        self._is_blind = False  # offsets are not known
        self._pushes, self._share = 0, 0.0
        self._pushed: deque[float] = deque(maxlen=_RECENT + 1)  # when the recent ones were over, on `_elapsed`
        self._told: float | None = None  # for pushing, since the first plan [s]

    def go_on(self) -> None:
        """A rest is over."""
        self._now = self._clock()

    def take(self, event: Event, most: int) -> tuple[float, float]:
        """Return what an event reports.

        Args:
            event: of the episode.
            most: pushes at most.

        Returns:
            Share of the episode that is over, which never falls, and time left [s].
        """
        now = self._clock()
        passed = now - self._now
        self._elapsed, self._now = self._elapsed + passed, now
        match event:
            case Looking(look=look) if look in _LOOK_S:
                self._look(look, event)
            case Stepped():
                self._left.clear()
                self._off_m, self._is_blind = float(event.offsets_m.sum()), event.offsets_m.size == 0
                self._first_off_m = self._first_off_m or self._off_m
                if self._told is None:
                    self._pushed.append(self._elapsed)
                    self._told = self._pushing(most)
            case ActionExecuted(number):
                self._pushed.append(self._elapsed)
                self._pushes = number
            case _:
                pass
        pushing = self._calmly(self._pushing(most), passed)
        left = 0.0 if isinstance(event, Finished) else sum(self._left.values()) + pushing
        self._share = max(self._share, self._elapsed / max(self._elapsed + left, 1e-9))
        return self._share, left

    def _look(self, look: str, event: Looking) -> None:
        begun = self._since.setdefault(look, self._elapsed)
        progress, spent = event.step.progress, self._elapsed - begun
        share = progress.done / progress.total if progress.total else 0.0
        whole = (1 - share) * _LOOK_S[look] + spent  # `spent / share` has the weight `share`
        self._left[look] = 0.0 if event.step.estimate is not None else (1 - share) * whole

    def _pushing(self, most: int) -> float:
        """Time for the pushes that are still needed [s]."""
        recent = self._pushed
        each = (recent[-1] - recent[0]) / (len(recent) - 1) if len(recent) > 1 else _ROUND_S
        usual = max(_PUSHES - self._pushes, _LAST_SHARE * self._pushes, 1.0)
        if self._is_blind:
            needed = float(most)
        elif self._first_off_m == 0:
            needed = usual
        else:
            mean_m = self._first_off_m / _PUSHES
            gained = self._first_off_m - self._off_m + _SURE * mean_m
            rate = max(gained / (self._pushes + _SURE), mean_m / 4)
            needed = (usual + self._off_m / rate) / 2
        return min(needed, max(most - self._pushes, 0)) * each

    def _calmly(self, left: float, passed: float) -> float:
        """Return what is told of a time left [s]."""
        if self._told is None:
            return left
        expected = self._told - passed
        change = (left - expected) * (1 - math.exp(-passed / _CALM_S))
        self._told = max(expected + min(change, 2 * passed), min(left, _ROUND_S))
        return self._told
