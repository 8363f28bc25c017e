# SPDX-License-Identifier: Apache-2.0
"""Tables of docs/nodes.md and the SROS2 policies, from the declarations that the nodes run by.

`python -m tools.node_tables` writes them; tests hold the files against this module, and
this module against the topics and services of running nodes.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from sst_ros.nodes import arguments, inverse_dynamics, simulation_interfaces, topics
from sst_ros.nodes.topics import CALLS, EXECUTES, PUBLISHES, SERVES, SUBSCRIBES, Endpoint
from sst_ros.runtime import diagnostics
from sst_ros.runtime.settings import SimulatorParameters, default_topics
from sst_ros.scene.schema import Section, Spec, specs

SIMULATOR = "sst_simulator"
LOG_AND_EVENTS = ("/rosout", "/parameter_events")
PARAMETER_SERVICES = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "get_type_description",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)
SIMULATION_INTERFACES = simulation_interfaces.SERVICES


class Described(NamedTuple):
    """A node: command, name in the graph, parameters, endpoints."""

    command: str
    name: str
    parameters: type[Section]
    endpoints: tuple[Endpoint, ...]


NODES = tuple(
    Described(command, f"sst_{command}", parameters, tuple(topics.NODES[command].values()))
    for command, (_, parameters) in arguments.COMMANDS.items()
)


def tables() -> dict[str, str]:
    """Give the text of every generated part of docs/nodes.md, by its name."""
    parts = {
        name: _table(("key", "what"), ((f"`{key}`", text) for key, text in keys.items()))
        for name, keys in (
            ("diagnostics", diagnostics.KEYS),
            ("inverse_dynamics diagnostics", inverse_dynamics.KEYS),
        )
    }
    for node in NODES:
        parts[f"{node.command} parameters"] = _table(
            ("parameter", "default", "allowed", "set at run time", "what"),
            _parameter_rows(node.parameters),
        )
        rows = [*_endpoint_rows(node.endpoints)]
        if node.command == "recorder":
            rows = [("subscribes", f"`{topic}`", "as published", "") for topic in default_topics()]
        parts[f"{node.command} topics and services"] = _table(("use", "name", "type", "what"), rows)
    return parts


def filled(text: str) -> str:
    """Put the generated parts between their marks."""
    for name, part in tables().items():
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        pattern = re.escape(begin) + ".*?" + re.escape(end)
        text, count = re.subn(
            pattern, f"{begin}\n{part}{end}".replace("\\", r"\\"), text, flags=re.S
        )
        if count != 1:
            raise ValueError(f"the text has {count} parts {name}")
    return text


def policy(node: Described) -> str:
    """Write the SROS2 policy of a node: what it needs by its declarations, and nothing else."""
    publish = {*LOG_AND_EVENTS, *_names(node, PUBLISHES)}
    subscribe = set(_names(node, SUBSCRIBES))
    reply = {f"/{node.name}/{name}" for name in PARAMETER_SERVICES} | set(_names(node, SERVES))
    executed = set(_names(node, EXECUTES))
    if node.command == "simulator":
        subscribe.add("/clock")  # with use_sim_time
        reply |= {f"/{node.name}/{name}" for name in SIMULATION_INTERFACES}
        executed.add(f"/{node.name}/simulate_steps")
    if node.command == "recorder":
        subscribe |= {*default_topics(), "/clock"}
    if node.command in ("torque_player", "inverse_dynamics", "viewer"):
        subscribe.add("/clock")
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            "<!-- SPDX-License-Identifier: Apache-2.0 -->",
            "<!-- Made by: python -m tools.node_tables -->",
            '<policy version="0.2.0">',
            "  <enclaves>",
            f'    <enclave path="/sst_ros/{node.command}">',
            "      <profiles>",
            f'        <profile ns="/" node="{node.name}">',
            *_rules("topics", "topic", "publish", publish),
            *_rules("topics", "topic", "subscribe", subscribe),
            *_rules("services", "service", "reply", reply),
            *_rules("services", "service", "request", _names(node, CALLS)),
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


def _parameter_rows(cls: type[Section]) -> Iterator[tuple[str, ...]]:
    defaults, changeable = cls(), getattr(cls, "CHANGEABLE", ())
    for name, spec in specs(cls).items():
        value = getattr(defaults, name)
        shown = str(value).lower() if isinstance(value, bool) else value
        if spec.kind == "texts":
            shown = "those of config/topics.txt" if value else "none"
        elif (cls, name) == (SimulatorParameters, "duration"):
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
    heads = list(heads)
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main() -> int:
    """Write the generated parts into the source tree."""
    root = Path(__file__).resolve().parents[1]
    page = root / "docs" / "nodes.md"
    page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
    for node in NODES:
        path = root / "config" / "sros2" / f"{node.command}.policy.xml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(policy(node), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
