"""The REST interface, one module a noun."""

from typing import Annotated, Any

from fastapi import Query

PROBLEM_REF = {"$ref": "#/components/schemas/Problem"}
PNG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}, "description": "The image."}
}
JPEG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/jpeg": {"schema": {"type": "string", "format": "binary"}}}, "description": "The photo."}
}
FORGOTTEN: dict[int | str, dict[str, Any]] = {204: {"description": "It is gone, with all its files."}}
Forget = Annotated[
    bool, Query(description="Remove one that has finished for good, with all its files; nothing is answered then.")
]


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries for the errors that a route answers."""
    return {
        status: {"content": {"application/problem+json": {"schema": PROBLEM_REF}}, "description": text}
        for status, text in ((s, _TEXTS[s]) for s in (400, 403, 413, 421, 422, *statuses))
    }


_TEXTS = {
    400: "The request cannot be read.",
    403: "The request comes from another site.",
    404: "There is no such thing.",
    409: "It does not fit the present state.",
    413: "The request is too large.",
    415: "The body is neither JSON nor a zip.",
    421: "The service is not known under this host name.",
    422: "The input is not valid; the detail says what is allowed.",
    429: "Too many jobs wait already.",
    503: "The simulation, the neural renderer or the predictor is being restarted.",
    507: "The disk is full, or the service holds as much as it may.",
}
