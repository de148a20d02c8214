"""The layouts for viewers name topics and fields that recordings have."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from graspd.daemon.record.topics import schemas

LAYOUTS = Path(__file__).parents[2] / "deploy" / "layouts"
LICHTBLICK = json.loads((LAYOUTS / "lichtblick.json").read_bytes())
PANELS = {"Image", "Plot", "StateTransitions", "RosOut"}
"""Panels of Lichtblick, by the names in its sources; RosOut is the log."""
QUOTED = re.compile(r'"([a-z]+)\.right"\.([A-Za-z0-9_.]+)(\[\d+\])?')
"""Pattern of a message path in Lichtblick, which needs quotes for a topic's name with a dot."""


def has(topic: str, field: str, *, in_list: bool = False) -> bool:
    """True if messages of a topic have a field, such as `motion.ff`, of one value; `in_list`: of a
    list."""
    told = json.loads(schemas()[topic][1])
    for name in field.split("."):
        told = told["properties"].get(name, {"type": "object", "properties": {}})
    wanted = {"array"} if in_list else {"number", "integer", "boolean", "string"}
    return told["type"] in wanted


def paths() -> Iterator[str]:
    for config in LICHTBLICK["configById"].values():
        yield from (path["value"] for path in config.get("paths", []))


def test_paths_of_the_lichtblick_layout_are_in_the_schemas() -> None:
    for path in paths():
        match = QUOTED.fullmatch(path)
        assert match is not None, path
        assert has(match[1], match[2], in_list=match[3] is not None), path


def test_image_and_log_panels_show_topics_of_their_type() -> None:
    panels = LICHTBLICK["configById"]
    (image,) = [panel for name, panel in panels.items() if name.startswith("Image!")]
    (log,) = [panel for name, panel in panels.items() if name.startswith("RosOut!")]
    assert schemas()[image["imageMode"]["imageTopic"].removesuffix(".right")][0] == (
        "foxglove.RawImage"
    )
    assert schemas()[log["topicToRender"].removesuffix(".right")][0] == "foxglove.Log"


def leaves(layout: Any) -> Iterator[str]:  # noqa: ANN401
    if isinstance(layout, str):
        yield layout
    else:
        assert layout["direction"] in {"row", "column"}
        yield from leaves(layout["first"])
        yield from leaves(layout["second"])


def test_every_panel_has_a_place_and_a_known_kind() -> None:
    placed = list(leaves(LICHTBLICK["layout"]))
    assert sorted(placed) == sorted(LICHTBLICK["configById"])
    assert {name.partition("!")[0] for name in placed} == PANELS


def test_the_curves_of_the_plotjuggler_layout_are_in_the_schemas() -> None:
    root = ElementTree.parse(LAYOUTS / "plotjuggler.xml").getroot()
    curves = [curve.attrib["name"] for curve in root.iter("curve")]
    assert len(curves) >= 5
    for curve in curves:
        topic, _, field = curve.partition(".right/")
        assert has(topic, field.replace("/", ".")), curve
    (splitter,) = root.iter("DockSplitter")
    areas = splitter.findall("DockArea")
    assert int(splitter.attrib["count"]) == len(areas) == len(splitter.attrib["sizes"].split(";"))
