# SPDX-License-Identifier: Apache-2.0
"""The reference of all keys of a scene, from the declarations that check them.

`python -m tools.scene_keys` writes docs/scenes.md; a test compares the two.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Section, Spec

_HEAD = """# Scenes

<!-- Written by `python -m tools.scene_keys`. -->

A scene is one YAML file. What it does not name does not exist: no operation in its dynamics, no
parameter, no topic. Units are SI and angles radians; keys in degrees end in `_deg`. Frames are the
paper's: {B} is fixed in the base, {E} in the star, {1k} = [r, w x r, w] in actuated link k and
{2k} = [r, t x r, t] in intermediate link k.

    sst-ros scene list           # the shipped scenes
    sst-ros scene show example2  # contents, cost of a step, advice on the method
    sst-ros scene check my.yaml  # every fault, with its line
    sst-ros scene schema > scene.schema.json   # for editors

With the schema beside a scene, editors that know the YAML language server complete and check it
by this first line: `# yaml-language-server: $schema=scene.schema.json`.
"""


def keys() -> str:
    """Write the reference as Markdown."""
    paths: dict[type[Section], list[str]] = {}
    for cls, path in _sections(Scene, ""):
        paths.setdefault(cls, []).append(path)
    return "\n".join([_HEAD, *(_table(cls, where) for cls, where in paths.items())])


def _sections(cls: type[Section], path: str) -> Iterator[tuple[type[Section], str]]:
    """Yield a section and all those in it, each with its key."""
    yield cls, path
    for field in dataclasses.fields(cls):
        spec: Spec = field.metadata["spec"]
        if spec.section is not None:
            entry = f"{field.name}[]" if spec.kind == "sections" else field.name
            yield from _sections(spec.section, f"{path}.{entry}" if path else entry)


def _table(cls: type[Section], paths: list[str]) -> str:
    title = ", ".join(f"`{path}`" if path else "The document" for path in paths)
    lines = [f"## {title}", "", inspect.getdoc(cls) or "", ""]
    lines += ["| key | meaning | must be | default |", "| --- | --- | --- | --- |"]
    for field in dataclasses.fields(cls):
        spec: Spec = field.metadata["spec"]
        allowed = spec.describe().removeprefix("must be ")
        lines.append(f"| `{field.name}` | {spec.doc} | {allowed} | {_default(field.default)} |")
    return "\n".join([*lines, ""])


def _default(value: Any) -> str:
    if value is dataclasses.MISSING:
        return "required"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Section):
        return "as below"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, tuple) and value:
        return "[" + ", ".join(f"{entry:g}" for entry in value) + "]"
    return "none" if value is None or value == () else str(value)


def main() -> int:
    """Write the page into the source tree."""
    page = Path(__file__).resolve().parents[1] / "docs" / "scenes.md"
    page.write_text(keys(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
