"""Sphinx extension: fills the pages `reference/rest-paths` and `rest-models` from the service's OpenAPI schema."""

import json
import re
from collections.abc import Iterator
from typing import Any

from sphinx.application import Sphinx

from app.api.app_factory import create_app

MODELS = "rest-models.md"
EVERYWHERE = {"400", "401", "403", "413", "421", "422"}  # the introduction of the page explains them
BOUNDS = (("minimum", "maximum", ""), ("minLength", "maxLength", " characters"), ("minItems", "maxItems", " entries"))


def bounds_of(schema: dict[str, Any]) -> str:
    """Return in words which numbers, lengths or counts a schema allows; "" where it allows all."""
    for least, most, unit in BOUNDS:
        low, high = schema.get(least), schema.get(most)
        if low is not None and high is not None:
            return f" ({low}{unit})" if low == high else f" ({low} to {high}{unit})"
        if low is not None or high is not None:
            return f" (at most {high}{unit})" if low is None else f" ({low}{unit} or more)"
    return ""


def type_of(schema: dict[str, Any]) -> str:
    """Return a schema's type and bounds in words, with links to the models that it names."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}]({MODELS}#{name.lower()})"
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return " or ".join(type_of(one) for one in schema[key])
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{json.dumps(value)}`" for value in schema.get("enum", [schema.get("const")]))
    kind = schema.get("type", "anything")
    if kind == "array":
        kind = f"list of {type_of(schema.get('items') or schema['prefixItems'][0])}"
    if kind == "object" and isinstance(schema.get("additionalProperties"), dict):
        kind = f"object of {type_of(schema['additionalProperties'])}"
    return kind + bounds_of(schema)


def table(title: str, rows: list[tuple[str, str, str]]) -> str:
    """Return a table of Markdown whose first column is code."""
    lines = [f"| {title} | type | meaning |", "|---|---|---|"]
    for name, kind, text in rows:
        cells = (f"`{name}`", kind, text)
        lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(lines)


def meaning(schema: dict[str, Any], is_required: bool) -> str:
    """Return a description with the default; what may be left out and has none is called optional."""
    words = [schema.get("description") or schema.get("items", {}).get("description", "")]
    if "default" in schema:
        words.append(f"Default: `{json.dumps(schema['default'])}`.")
    elif not is_required:
        words.append("Optional.")
    return " ".join(words).strip()


def content(kinds: dict[str, Any]) -> str:
    """Return the model of JSON, and the media type of anything else."""
    return " or ".join(type_of(one["schema"]) if kind == "application/json" else kind for kind, one in kinds.items())


def operation(method: str, path: str, told: dict[str, Any]) -> Iterator[str]:
    """Yield the parts of one operation's section."""
    yield f"### {method.upper()} {path}"
    yield told.get("description", told["summary"])
    parameters = told.get("parameters", ())
    if parameters:
        kinds = [f"{type_of(one['schema'])}, in the {one['in']}" for one in parameters]
        meanings = [meaning(one["schema"], one.get("required", False)) for one in parameters]
        names = [one["name"] for one in parameters]
        yield table("parameter", list(zip(names, kinds, meanings, strict=True)))
    if "requestBody" in told:
        optional = "" if told["requestBody"].get("required") else ", optional"
        yield f"Body{optional}: {content(told['requestBody']['content'])}"
    for status, answer in told["responses"].items():
        if status.startswith("2"):
            yield f"Answer {status}: {content(answer['content']) if 'content' in answer else 'nothing'}"
    own = [status for status in told["responses"] if status[0] in "45" and status not in EVERYWHERE]
    if own:
        yield "\n".join(["Errors:", "", *(f"- {status}: {told['responses'][status]['description']}" for status in own)])


def paths(schema: dict[str, Any]) -> Iterator[str]:
    """Yield the sections of all operations, by tag."""
    for tag in schema["tags"]:
        yield f"## {tag['name'].capitalize()}\n\n{tag['description']}"
        for path, methods in schema["paths"].items():
            for method, told in methods.items():
                if told["tags"] == [tag["name"]]:
                    yield from operation(method, path, told)


def models(schema: dict[str, Any]) -> Iterator[str]:
    """Yield the section of each model, sorted by name."""
    for name, told in sorted(schema["components"]["schemas"].items()):
        text, _, attributes = told.get("description", "").partition("\n\nAttributes:\n")
        yield f"## {name}\n\n{text}"
        meanings = dict(re.findall(r"^    (\w+): (.+(?:\n     .+)*)", attributes, re.MULTILINE))
        required = told.get("required", ())
        fields = [
            (field, {"description": " ".join(meanings.get(field, "").split()), **one})
            for field, one in told.get("properties", {}).items()
        ]
        rows = [(field, type_of(one), meaning(one, field in required)) for field, one in fields]
        yield table("field", rows) if rows else type_of(told)


PAGES = {"reference/rest-paths": paths, "reference/rest-models": models}


def fill(_app: Sphinx, page: str, source: list[str]) -> None:
    """Append the sections to their page when it is read."""
    if page in PAGES:
        source[0] = "\n\n".join([source[0], *PAGES[page](create_app().openapi())])


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", fill)
    return {"parallel_read_safe": True}
