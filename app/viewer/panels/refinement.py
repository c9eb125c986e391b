"""How careful the next picture of a view should be: coarse while something moves, sharper by steps once it rests."""

from __future__ import annotations

from dataclasses import dataclass

REST_S = 0.3


@dataclass(frozen=True, slots=True)
class Step:
    """One stage of refinement.

    Attributes:
        rows: height of the picture [px].
        is_sharp: whether it is rendered with fine sampling and with depth.
    """

    rows: int
    is_sharp: bool


STEPS = (Step(112, is_sharp=False), Step(256, is_sharp=True), Step(480, is_sharp=True))


@dataclass(frozen=True, slots=True)
class RenderTicket:
    """A requested picture.

    Attributes:
        movement: number of the movement after which it was requested.
        step: index into `STEPS`.
    """

    movement: int
    step: int


class Refinement:
    """The state of one view. Times are in seconds of one clock; one thread at a time."""

    def __init__(self) -> None:
        self._movement = 0
        self._moved_at = 0.0
        self._step = 0
        self._ordered: RenderTicket | None = None

    def moved(self, now: float) -> None:
        """Something that the view shows has moved, or the view itself."""
        self._movement += 1
        self._moved_at, self._step = now, 0

    def due_at(self) -> float | None:
        """When the next picture should be ordered; None while an ordered one is worth waiting for, and at the end.

        A quick picture is waited for even while things move on: that sets the pace. A sharp one is not.
        """
        waits = self._ordered is not None and (self._ordered.step == 0 or self._ordered.movement == self._movement)
        if waits or self._step == len(STEPS):
            return None
        return self._moved_at if self._step == 0 else self._moved_at + REST_S

    def order(self) -> RenderTicket:
        """Note that the next picture is being made; whatever was ordered before does not count any more."""
        self._ordered = RenderTicket(self._movement, self._step)
        return self._ordered

    def accept(self, ticket: RenderTicket, *, is_there: bool) -> bool:
        """Note the answer to an order, with a picture or without; tells whether the picture should be shown."""
        if ticket != self._ordered:
            return False
        self._ordered = None
        is_fresh = ticket.movement == self._movement
        if is_there and is_fresh:
            self._step = ticket.step + 1
        return is_there and (is_fresh or ticket.step == 0)

    def give_up(self, ticket: RenderTicket) -> None:
        """Note that no picture can be made before something moves."""
        if ticket == self._ordered:
            self._ordered, self._step = None, len(STEPS)
