# SPDX-License-Identifier: Apache-2.0
"""Tables of reference pages and SROS2 policies from the program's declarations.

`python -m tools.reference_pages` writes them, the tables between the marks of each
page, as in

    <!-- begin recorder parameters -->
    | parameter | default | allowed | set at run time | what |
    | --- | --- | --- | --- | --- |
    | `output` | recordings/... |
    <!-- end recorder parameters -->

Tests hold the files against this module, and this module against running nodes.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pandas import DataFrame

from benchmark import measure
from sst_ros.cli import commands
from sst_ros.nodes import inverse_dynamics, simulation_interfaces, topics
from sst_ros.nodes.topics import (
    CALLED_SERVICES,
    EXECUTES,
    PUBLISHES,
    SERVES,
    SUBSCRIBES,
    Endpoint,
)
from sst_ros.recording.topic_tables import TABLES, TIMES, Column
from sst_ros.report.results import markdown
from sst_ros.runtime import diagnostics, settings
from sst_ros.runtime.settings import (
    NodeParameters,
    SimulatorParameters,
    default_topics,
)
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import REQUIRED, Section, Spec

ROOT = Path(__file__).resolve().parents[1]
SIMULATOR = "sst_simulator"
LOG_AND_EVENTS = ("/rosout", "/parameter_events")
PARAMETER_SERVICES = (
    "describe_parameters get_parameter_types get_parameters get_type_description"
    " list_parameters set_parameters set_parameters_atomically"
)
SIMULATION_INTERFACES = simulation_interfaces.SERVICES


class Described(NamedTuple):
    """A node: command, name in the graph, parameters, endpoints."""

    command: str
    name: str
    parameters: type[NodeParameters]
    endpoints: tuple[Endpoint, ...]


NODES = tuple(
    Described(
        command,
        f"sst_{command}",
        parameters,
        tuple(topics.NODE_TOPICS[command].values()),
    )
    for command, (_, parameters) in settings.NODE_COMMANDS.items()
)


def commands_tables() -> Iterator[tuple[str, str]]:
    """Yield the parts of docs/commands.md: name and text."""
    yield "nodes", ", ".join(f"`{name}`" for name in commands.NODE_HELP) + ".\n"
    text = ""
    for name, entry in commands.SUBCOMMANDS.items():
        if not isinstance(entry, str):
            rows = [*map(_argument_row, entry.arguments)]
            arguments_of = (
                _table(("argument", "what"), rows) if rows else "No arguments.\n"
            )
            first_letter = entry.description[:1].upper()
            sentence = f"{first_letter}{entry.description[1:]}."
            text += f"## {name}\n\n{sentence}\n\n{arguments_of}\n"
    yield "commands", text


def _argument_row(argument: commands.Arg) -> tuple[str, str]:
    name, options = argument.name, argument.options
    shown = options.get("metavar") or name.lstrip("-").replace("-", "_").upper()
    if not name.startswith("-"):
        name = shown
    elif options.get("action") != "store_true":
        choices = options.get("choices")
        name += " {" + ",".join(choices) + "}" if choices else f" {shown}"
    more = " ..." if options.get("nargs") in ("*", "+") else ""
    return f"`{name}{more}`", (options["help"] or "").replace("|", ",")


def columns_tables() -> Iterator[tuple[str, str]]:
    """Yield the parts of docs/columns.md: name and text."""
    yield "times", _columns(TIMES)
    for name, sources in TABLES.items():
        yield (
            name,
            _columns([column for source in sources for column in source.columns]),
        )


def _columns(listed: Iterable[Column]) -> str:
    rows = ((f"`{c.name}`", c.what, c.unit, c.topic or "-") for c in listed)
    return _table(("column", "what", "unit", "topic"), rows)


def scenes_tables() -> Iterator[tuple[str, str]]:
    """Yield the one part of docs/scenes.md: all sections of a scene with their keys."""
    paths: dict[type[Section], list[str]] = {}
    for cls, path in _sections(Scene, ""):
        paths.setdefault(cls, []).append(path)
    yield "keys", "\n".join(_section(cls, where) for cls, where in paths.items())


def _sections(cls: type[Section], path: str) -> Iterator[tuple[type[Section], str]]:
    """Yield a section and all those in it, each with its key."""
    yield cls, path
    for name, spec in cls.SPECS.items():
        if spec.section is not None:
            entry = f"{name}[]" if spec.kind == "sections" else name
            yield from _sections(spec.section, f"{path}.{entry}" if path else entry)


def _section(cls: type[Section], paths: list[str]) -> str:
    title = ", ".join(f"`{path}`" if path else "The document" for path in paths)
    rows = []
    for name, spec in cls.SPECS.items():
        rows.append((f"`{name}`", spec.doc, _allowed(spec), _default(spec.default)))
    keys = _table(("key", "meaning", "must be", "default"), rows)
    return f"## {title}\n\n{inspect.getdoc(cls) or ''}\n\n{keys}"


def _default(value: Any) -> str:
    if value is REQUIRED:
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


def nodes_tables() -> Iterator[tuple[str, str]]:
    """Yield the parts of docs/nodes.md: name and text."""
    for name, keys in (
        ("diagnostics", diagnostics.KEYS),
        ("inverse_dynamics diagnostics", inverse_dynamics.FOLLOWER_KEYS),
    ):
        yield (
            name,
            _table(("key", "what"), ((f"`{key}`", text) for key, text in keys.items())),
        )
    heads = ("parameter", "default", "allowed", "set at run time", "what")
    for node in NODES:
        yield (
            f"{node.command} parameters",
            _table(heads, _parameter_rows(node.parameters)),
        )
        rows = [*_endpoint_rows(node.endpoints)]
        if node.command == "recorder":
            rows = [
                ("subscribes", f"`{topic}`", "as published", "")
                for topic in default_topics()
            ]
        yield (
            f"{node.command} topics and services",
            _table(("use", "name", "type", "what"), rows),
        )


PAGES = {
    "commands.md": commands_tables,
    "columns.md": columns_tables,
    "scenes.md": scenes_tables,
    "nodes.md": nodes_tables,
}


def fill(name: str, text: str) -> str:
    """Put the generated parts of a page between their marks."""
    return measure.fill(text, {part: content[:-1] for part, content in PAGES[name]()})


def policy(node: Described) -> str:
    """Write the SROS2 policy of a node: what its declarations need, nothing else."""
    publish = {*LOG_AND_EVENTS, *_names(node, PUBLISHES)}
    subscribe = {"/clock", *_names(node, SUBSCRIBES)}  # the clock with use_sim_time
    reply = {f"/{node.name}/{name}" for name in PARAMETER_SERVICES.split()}
    reply |= set(_names(node, SERVES))
    executed = set(_names(node, EXECUTES))
    if node.command == "simulator":
        reply |= {f"/{node.name}/{name}" for name in SIMULATION_INTERFACES}
        executed.add(f"/{node.name}/simulate_steps")
    if node.command == "recorder":
        subscribe |= set(default_topics())
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            "<!-- SPDX-License-Identifier: Apache-2.0 -->",
            "<!-- Made by: python -m tools.reference_pages -->",
            '<policy version="0.2.0">',
            "  <enclaves>",
            f'    <enclave path="/sst_ros/{node.command}">',
            "      <profiles>",
            f'        <profile ns="/" node="{node.name}">',
            *_rules("topics", "topic", "publish", publish),
            *_rules("topics", "topic", "subscribe", subscribe),
            *_rules("services", "service", "reply", reply),
            *_rules("services", "service", "request", _names(node, CALLED_SERVICES)),
            *_rules("actions", "action", "execute", executed),
            "        </profile>",
            "      </profiles>",
            "    </enclave>",
            "  </enclaves>",
            "</policy>",
            "",
        ]
    )


def _rules(group: str, entry: str, right: str, names: Iterable[str]) -> Iterator[str]:
    listed = sorted(names)
    if not listed:
        return
    yield f'          <{group} {right}="ALLOW">'
    for name in listed:
        yield f"            <{entry}>{name}</{entry}>"
    yield f"          </{group}>"


def _names(node: Described, use: str) -> Iterator[str]:
    for endpoint in node.endpoints:
        if endpoint.use == use:
            yield endpoint.at(f"/{node.name}").format(simulator=SIMULATOR)


def _parameter_rows(cls: type[NodeParameters]) -> Iterator[tuple[str, ...]]:
    defaults, changeable = cls(), cls.CHANGEABLE
    for name, spec in cls.SPECS.items():
        value = getattr(defaults, name)
        shown = str(value).lower() if isinstance(value, bool) else value
        if spec.kind == "texts":
            shown = "those of config/topics.txt" if value else "none"
        elif (cls, name) == (SimulatorParameters, "duration"):
            shown = "0.0, in lockstep that of the scene"
        elif name.startswith("state_gamma"):
            shown = "that of the scene"
        elif isinstance(value, tuple):
            shown = list(value)
        may = "yes" if name in changeable else "no"
        yield f"`{name}`", f"{shown}", _allowed(spec), may, spec.doc


def _allowed(spec: Spec) -> str:
    return spec.describe().removeprefix("must be ")


def _endpoint_rows(listed: Iterable[Endpoint]) -> Iterator[tuple[str, ...]]:
    for endpoint in listed:
        text = endpoint.doc + ("; kept for late joiners" if endpoint.latched else "")
        if endpoint.when:
            text += f"; only where {endpoint.when}"
        yield endpoint.use, f"`{endpoint.name}`", endpoint.type_name, text


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    return markdown(DataFrame(map(list, rows), columns=list(heads))) + "\n"


def main() -> None:
    """Write pages and policies into the source tree."""
    for name in PAGES:
        page = ROOT / "docs" / name
        page.write_text(fill(name, page.read_text(encoding="utf-8")), encoding="utf-8")
    for node in NODES:
        path = ROOT / "config" / "sros2" / f"{node.command}.policy.xml"
        path.write_text(policy(node), encoding="utf-8")


if __name__ == "__main__":
    main()
