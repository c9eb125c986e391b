"""A sentence in the viewer's panel."""

from __future__ import annotations

from html import escape

_STYLE = "margin:0;padding:0.2em 0.75em 0.5em;font-size:0.8em;line-height:1.35"


def status(about: str, text: str) -> str:
    """HTML of a sentence about something, a word; the text may hold names that users choose."""
    return f'<p class="{about}-status" style="{_STYLE}">{escape(text)}</p>'
