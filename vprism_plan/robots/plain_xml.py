# SPDX-License-Identifier: BSD-3-Clause
"""XML files of robots, without what lets a small file grow or take for ever."""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from vprism_plan.errors import RobotError

_DEEPEST = 100  # elements in each other
MOST_BYTES = 2**23  # 8 MiB; PR2's description has 0.1
_MOST_NODES = 100_000  # of a COLLADA scene


class _Plain(ET.TreeBuilder):
    """Builds elements; refuses document types, which declare entities, and bottomless nesting."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path, self._depth = path, 0

    def doctype(self, name: str, *_: Any) -> None:
        raise RobotError(f"'{self._path}' has a <!DOCTYPE {name}>; take it out, no robot needs one")

    def start(self, tag: Any, attrs: Any) -> Any:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise RobotError(f"'{self._path}' has elements more than {_DEEPEST} deep in each other")
        return super().start(tag, attrs)

    def end(self, tag: Any) -> Any:
        self._depth -= 1
        return super().end(tag)


def plain_xml(path: Path) -> ET.Element:
    """Return the root of an XML file, which must be of plain elements."""
    try:
        return ET.fromstring(path.read_bytes(), ET.XMLParser(target=_Plain(path)))
    except ET.ParseError as error:
        raise RobotError(f"'{path}' is not well-formed XML: {error}") from error


def robot_element(path: Path, what: str) -> ET.Element:
    """Return the <robot> of a file; `what` is "a URDF" or "an SRDF", for messages."""
    root = plain_xml(path)
    if root.tag != "robot":
        raise RobotError(f"the root element of '{path}' is <{root.tag}>, {what} has <robot>")
    return root


def refuse_growing_scene(path: Path) -> None:
    """Refuse a COLLADA file whose nodes stand for each other more often than memory holds.

    Raises RecursionError where a node stands for itself.
    """
    elements = [(element.tag.rpartition("}")[2], element) for element in plain_xml(path).iter()]
    by_id = {element.get("id"): element for tag, element in elements if tag == "node"}

    @functools.cache
    def nodes(element: ET.Element) -> int:
        """Nodes below an element, with all that they stand for."""
        total = 0
        for below in element.iter():
            tag = below.tag.rpartition("}")[2]
            if tag == "instance_node" and below.get("url", "")[1:] in by_id:
                total += 1 + nodes(by_id[below.get("url", "")[1:]])
            total += tag == "node"
        return total

    for tag, element in elements:
        if tag == "visual_scene" and nodes(element) > _MOST_NODES:
            raise RobotError(
                f"'{path}' stands for more than {_MOST_NODES:,} nodes; save it without instances"
            )
