"""What the events of an episode mean, for a person who follows it."""

from __future__ import annotations

from osfcore.control.events import ActionExecuted, Event, GoalFound, Looking, Noticed, Planning, Stepped

_FOUND = {
    "first": "Knows where everything is",
    "goal": "Comparing the goal image with the table",
    "next": "Knows where everything is now",
    "search": "Knows where everything is now",
}


def note_of(event: Event) -> str | None:
    """What is being done, for a person; None if this event changes nothing about it."""
    match event:
        case Looking():
            if event.step.estimate is not None:
                return _FOUND[event.look]
            where = {"first": "first frame", "goal": "goal image", "next": "table", "search": "lost objects"}
            return f"Looking at the {where[event.look]}: {event.step.progress.note}"
        case GoalFound():
            return "Knows where everything should be"
        case Stepped() | Planning():
            return "Planning pushes"
        case ActionExecuted():
            return "Pushing"
        case Noticed():
            return event.text
        case _:
            return None


def stage_of(event: Event) -> str | None:
    """Which part of the loop an event belongs to; None if it says nothing about that."""
    match event:
        case Looking():
            return event.look
        case Stepped() | Planning():
            return "plan"
        case ActionExecuted():
            return "act"
        case _:
            return None
