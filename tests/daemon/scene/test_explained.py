"""Schema, page and examples of the scene agree with its classes."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from graspd.daemon.scene import explained
from tests.kit.inside import graspd, output

DEPLOY = Path(__file__).parents[3] / "deploy"
SCHEMA = explained.schema()
UNITS = {"_ms": "ms", "_s": "s", "_hz": "1/s", "_mb": "MB", "_minutes": "minutes"}
"""Unit of a key by the end of its name."""


def keys_of(section: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """All keys of all sections, by path, with the schema of each."""
    for key, about in section["properties"].items():
        yield f"{path}{key}", about
        for inner in about.get("oneOf", (about,)):
            if "properties" in inner:
                yield from keys_of(inner, f"{path}{key}.")


KEYS = list(keys_of(SCHEMA))


def numbers(about: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    if about.get("type") in ("integer", "number"):
        yield about
    elif "items" in about:
        yield from numbers(about["items"])


def test_every_key_has_a_meaning_and_every_number_a_unit() -> None:
    for key, about in KEYS:
        meaning = about["description"]
        assert meaning.endswith((".", ")")), key
        assert meaning[0].isupper() or meaning.startswith("`"), key
        for number in numbers(about):
            assert number["unit"], key
            for ending, unit in UNITS.items():
                if key.endswith(ending) and not key.endswith("_per_s"):
                    assert number["unit"] == unit, key
            assert number["unit"] == "-" or f"Unit: {number['unit']}." in meaning, key


def test_the_package_has_the_very_examples_of_deploy() -> None:
    assert explained.EXAMPLES.resolve() == DEPLOY / "scenes"
    assert {"spi", "can", "palm", "demo"} <= set(explained.examples())


def test_the_schema_is_valid_and_committed() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert (DEPLOY / "scenes" / explained.SCHEMA).read_text() == explained.schema_text(), (
        "run: python -m graspd scene --schema > deploy/scenes/scene.schema.json"
    )
    assert graspd("scene", "--schema").stdout == explained.schema_text()


def test_the_page_of_all_keys_is_up_to_date() -> None:
    text = (DEPLOY / "SCENE.md").read_text()
    assert text == explained.page(), "run: python -m graspd scene --page > deploy/SCENE.md"
    assert text == graspd("scene", "--page").stdout
    assert "\n- `max_age_ms = 100.0` (ms, above 0 to 10_000). " in text
    assert "\n- `port` (string, *needed*). " in text
    assert "\n- `sensors` (1 to 3 of `ff`, `mf`, `rf`, `lf`, `th`). " in text
    for link in (part.split(")")[0] for part in text.split("](")[1:]):
        assert (DEPLOY / link).exists(), link


@pytest.mark.parametrize("name", explained.examples())
def test_an_example_scene_passes_check_in_any_folder(name: str, tmp_path: Path) -> None:
    text = output("scene", "--example", name)
    path = tmp_path / "right.toml"
    path.write_text(text)
    assert text.startswith("#:schema file:///")
    file = DEPLOY / "scenes" / f"{name}.toml"
    assert file.read_text().startswith(f"#:schema ./{explained.SCHEMA}\n")
    assert len(text.splitlines()) == len(file.read_text().splitlines())
    checked = graspd("check", path)
    assert (checked.returncode, checked.stdout.splitlines()[0]) == (0, f"{path}: fine")
    jsonschema.validate(tomllib.loads(text), SCHEMA)
