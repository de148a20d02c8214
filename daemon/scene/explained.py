"""Explain the scene from its own classes: JSON Schema, deploy/SCENE.md, examples."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import graspd.drivers.recordings
from graspd.daemon.scene import Scene

EXAMPLES = Path(__file__).parent / "examples"
"""Folder of examples: in the repository a link to deploy/scenes, installed a copy."""
SCHEMA = "scene.schema.json"
"""File beside the examples; their first line names it for editors."""
DIALECT = "https://json-schema.org/draft/2020-12/schema"
INTRODUCTION = """# The scene, key by key

For those who write a scene: one TOML file, in which only `[tactile]` must be there.
`graspd scene --example spi > right.toml` prints one to edit, and `graspd check right.toml` finds
mistakes. Editors with Taplo (VS Code: Even Better TOML) complete the keys.

`key = value` shows the default. A key without one may be left out, unless it is *needed*. Paths are
relative to the folder of the scene file.
"""


def examples() -> list[str]:
    """Return the names of the example scenes, sorted."""
    return sorted(path.stem for path in EXAMPLES.glob("*.toml"))


def example(name: str) -> str:
    """Return an example scene with absolute paths, so that it works from any folder.

    Links stay in the paths: an update of an installation changes the folder behind one.
    """
    text = (EXAMPLES / f"{name}.toml").read_text()
    recordings = Path(graspd.drivers.recordings.__file__).absolute().parent
    text = text.replace("../../drivers/recordings", str(recordings))
    return text.replace(f"./{SCHEMA}", (EXAMPLES / SCHEMA).absolute().as_uri())


def schema() -> dict[str, Any]:
    """Return the JSON Schema of a scene, with units of numbers and without null."""
    whole = Scene.model_json_schema()
    sections = whole.pop("$defs")
    for section in (whole, *sections.values()):
        for about in section["properties"].values():
            _describe(about)
    return {"$schema": DIALECT, **_plain(whole, sections)}


def schema_text() -> str:
    """Return the text of the file `SCHEMA`."""
    return json.dumps(schema(), indent=2) + "\n"


def page() -> str:
    """Return the text of deploy/SCENE.md: a list of keys for each section."""
    parts = [INTRODUCTION]
    for section in _sections(schema()):
        title, _, about = _linked(section["description"]).partition(": ")
        lines = [
            _line(key, value, key in section.get("required", ()))
            for key, value in section["properties"].items()
            if "const" not in value and "properties" not in value
        ]
        parts.append(f"## {title}\n\n{about[0].upper()}{about[1:]}\n\n{''.join(lines)}")
    return "\n".join(parts)


def _describe(about: dict[str, Any]) -> None:
    """Add a key's unit to its description; a section takes the description of its class."""
    meaning = " ".join(about.pop("description", "").split())
    if "$ref" in about:
        about.pop("default", None)
    elif meaning:
        unit = _unit(about)
        about["description"] = meaning if unit in ("", "-") else f"{meaning} Unit: {unit}."


def _unit(about: Mapping[str, Any]) -> str:
    """Return the unit of a number or of a list of numbers; "" for other types."""
    inner = (*about.get("anyOf", ()), about.get("items", {}))
    return about.get("unit") or next(filter(None, map(_unit, filter(None, inner))), "")


def _plain(node: Any, sections: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return a schema with `sections` in place of references to them, without null and titles."""
    if isinstance(node, list):
        return [_plain(item, sections) for item in node]
    if not isinstance(node, dict):
        return node
    whole = dict(node)
    if "$ref" in whole:
        whole = sections[whole.pop("$ref").rpartition("/")[2]] | whole
    left = [choice for choice in whole.get("anyOf", ()) if choice != {"type": "null"}]
    if len(left) == 1:
        del whole["anyOf"]
        whole = {**left[0], **whole}
    if "$ref" in whole:
        return _plain(whole, sections)
    return {
        key: _plain(value, sections)
        for key, value in whole.items()
        if key not in ("title", "discriminator") and (key, value) != ("default", None)
    }


def _sections(of: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield all sections below the section `of`, in the order of the file."""
    for about in of["properties"].values():
        for section in about.get("oneOf", (about,)):
            if "properties" in section:
                yield section
                yield from _sections(section)


def _line(key: str, about: Mapping[str, Any], is_needed: bool) -> str:
    """Return the line of a key: default, type where no default shows it, unit, range, meaning."""
    item = about.get("items")
    default = f" = {json.dumps(about['default'])}" if "default" in about else ""
    kind = f"list of {_type(item)}s" if item else _type(about)
    joint = " of " if item and "enum" in item else ", "
    facts = (
        "" if default or "enum" in (item or about) else kind,
        "*needed*" if is_needed else "",
        _unit(about).removeprefix("-"),
        joint.join(filter(None, (_lengths(about), _range(item or about)))),
    )
    given = ", ".join(filter(None, facts))
    meaning = _linked(about["description"].removesuffix(f" Unit: {_unit(about)}."))
    return f"- `{key}{default}`{given and f' ({given})'}. {meaning}\n"


def _type(about: Mapping[str, Any]) -> str:
    return str(about.get("format", about["type"]))


def _lengths(about: Mapping[str, Any]) -> str:
    if "minItems" not in about:
        return ""
    most = f" to {about['maxItems']}" if "maxItems" in about else " or more"
    return f"{about['minItems']}{most}"


def _range(about: Mapping[str, Any]) -> str:
    if "const" in about or "enum" in about:
        return ", ".join(f"`{value}`" for value in about.get("enum", [about.get("const")]))
    if "pattern" in about:
        return f"`{about['pattern']}`"
    words = (
        ("minimum", "from"),
        ("exclusiveMinimum", "above"),
        ("maximum", "to"),
        ("exclusiveMaximum", "below"),
    )
    bounds = " ".join(f"{word} {_number(about[key])}" for key, word in words if key in about)
    return bounds.removeprefix("from ") if "maximum" in about else bounds


def _number(value: float) -> str:
    """Return a number as in TOML, such as 12_000_000."""
    return f"{int(value):_}" if value == int(value) else str(value)


def _linked(text: str) -> str:
    """Return text in which names of files in deploy are links for a page in that folder."""
    return re.sub(r"deploy/([\w./-]+\w)", r"[\1](\1)", " ".join(text.split()))
