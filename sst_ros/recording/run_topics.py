# SPDX-License-Identifier: Apache-2.0
"""Which topics of a recording belong to one run: those of the node that publishes its scene.

A recording may hold more than one robot, and topics of others whose names end alike:
`/joint_state_broadcaster/joint_states`, the commands of another controller. The simulator
publishes its scene, so that the name of this topic names its node; its other topics are
named after the node, `joint_states` lies in the namespace of the node, and so do the
controllers that follow a reference.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

from sst_ros.errors import InputError, Problem, refusal
from sst_ros.recording.bag_reader import (
    CONTROLLER,
    EVERYBODY,
    NAMESPACE,
    SIMULATOR,
    Bag,
    Topic,
)
from sst_ros.recording.topic_tables import EULER, ORIENTATION, SCENE, TICKS, TRUE_JOINT_STATES

PUBLISHED = {one.key for one in (SCENE, ORIENTATION, EULER, TICKS, TRUE_JOINT_STATES)}
"""Topics that a simulator publishes under its own name; others publish its commands."""


class RunTopics(NamedTuple):
    """The topics of one run."""

    namespace: str  # of the simulator, "/" for the root
    node: str | None  # full name of the simulator's node; None where no topic shows it
    names: dict[str, str]  # full name of each topic by its key
    others: frozenset[str] = frozenset()  # namespaces of other runs in the recording

    def is_of_another(self, name: str) -> bool:
        """Return whether a topic, or a status by the name of its node, is of another run."""
        return _parent(name.partition(":")[0]) in self.others


def select_topics(
    bag: Bag, heard: Collection[str], namespace: str | None = None
) -> RunTopics:
    """Return the topics of the run in a namespace, by default of the only one.

    `heard` are the topics that have messages of this robot. Raises InputError where there is
    no run in the namespace, or none is given and there are several, or where two nodes
    publish what only one can.
    """
    nodes = _find_simulators(bag.candidates)
    spaces = {_parent(node) for node in nodes} or _find_namespaces(bag.candidates)
    chosen = _choose_namespace(bag, spaces, namespace)
    here = sorted(node for node in nodes if _parent(node) == chosen)
    if len(here) > 1:
        allowed = "are of several simulators in one namespace; record one simulator a bag"
        raise refusal(bag.path, SCENE.key, ", ".join(here), allowed)
    node = here[0] if here else None
    names = dict[str, str]()
    for name, topic in bag.candidates.items():
        own = {
            EVERYBODY: True,
            SIMULATOR: _parent(name) == node,
            NAMESPACE: name == chosen.rstrip("/") + topic.ending,
            CONTROLLER: False,
        }
        if own[topic.owner]:
            names[topic.key] = name
    alone = len(spaces) == 1
    names |= _find_controllers(bag, heard, chosen, alone)
    return RunTopics(chosen, node, names, frozenset({*spaces} - {chosen}))


def find_absent(bag: Bag, requested: Collection[Topic], run: RunTopics) -> dict[str, Problem]:
    """Return why a requested topic of a run is missing, by its key."""
    found = {}
    for topic in (one for one in requested if one.key not in run.names):
        others = sorted(name for name in bag.channels if topic.may_be(name))
        typed = [f"{name} ({bag.channels[name]})" for name in others]
        allowed = f"no topic of type {topic.type} ends in {topic.ending}; record it"
        if any(name in bag.candidates for name in others):
            typed, where = others, run.node if topic.owner == SIMULATOR else run.namespace
            allowed = f"no such topic is of {where}, whose scene is recorded; record it"
        found[topic.key] = Problem(topic.key, ", ".join(typed) or None, allowed)
    return found


def _choose_namespace(bag: Bag, spaces: Collection[str], namespace: str | None) -> str:
    """Return the namespace that is asked for, or the only one; InputError names all."""
    listed = ", ".join(sorted(spaces))
    if namespace is not None:
        asked = "/" + namespace.strip("/")
        if asked not in spaces:
            allowed = f"must be one in which a run is recorded: {listed or 'there is none'}"
            raise refusal(bag.path, "namespace", namespace, allowed)
        return asked
    if len(spaces) > 1:
        allowed = f"must be one of {listed}: the recording has a run in each (--namespace)"
        raise refusal(bag.path, "namespace", None, allowed)
    return next(iter(spaces), "/")


def _find_simulators(candidates: Mapping[str, Topic]) -> list[str]:
    """Full names of the nodes that publish a scene; without one, those with other topics."""
    topics: dict[str, set[str]] = {}
    for name, topic in candidates.items():
        if topic.owner == SIMULATOR:
            topics.setdefault(_parent(name), set()).add(topic.key)
    publishing = {node: keys & PUBLISHED for node, keys in topics.items() if keys & PUBLISHED}
    with_scene = {node: keys for node, keys in publishing.items() if SCENE.key in keys}
    # Another node may publish a text of the name `scene`, but nothing else of a simulator.
    sure = [node for node, keys in with_scene.items() if len(keys) > 1]
    return sure or [*with_scene] or [*publishing] or [*topics]


def _find_namespaces(candidates: Mapping[str, Topic]) -> set[str]:
    """Namespaces of runs of which no topic of the simulator's node is recorded."""
    beside = {_parent(n) for n, topic in candidates.items() if topic.owner == NAMESPACE}
    below = {_parent(_parent(n)) for n, topic in candidates.items() if topic.owner == CONTROLLER}
    return beside or below


def _find_controllers(
    bag: Bag, heard: Collection[str], namespace: str, alone: bool
) -> dict[str, str]:
    """Topics of the controller of a run by their keys: of the node that publishes most of them.

    It is a node in the namespace; where the recording has one run `alone`, of any.
    """
    nodes: dict[str, dict[str, str]] = {}
    for name, topic in bag.candidates.items():
        if topic.owner == CONTROLLER and name in heard:
            nodes.setdefault(_parent(name), {})[topic.key] = name
    near = {node: found for node, found in nodes.items() if _parent(node) == namespace}
    chosen = near or (nodes if alone else {})
    most = max(map(len, chosen.values()), default=0)
    best = {node: found for node, found in chosen.items() if len(found) == most}
    if len(best) > 1:
        allowed = "are of several controllers of this robot; record one controller a bag"
        problem = Problem("reference", ", ".join(sorted(best)), allowed)
        raise InputError(str(bag.path), [problem])
    return next(iter(best.values()), {})


def _parent(name: str) -> str:
    """Return the name of the node of a topic, or the namespace of a node."""
    return name.rpartition("/")[0] or "/"
