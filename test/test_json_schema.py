# SPDX-License-Identifier: Apache-2.0
"""The JSON schema accepts what `read` accepts and refuses what it can.

The key reference is new.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from sst_ros import __main__ as cli
from sst_ros.scene.scene import Scene, names, text_of
from sst_ros.scene.yaml_document import json_schema

jsonschema = pytest.importorskip("jsonschema")

ROOT = Path(__file__).parents[1]
SCHEMA = json_schema(Scene)
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)


def tree(name="example2_heavy"):
    return yaml.safe_load(text_of(name)[0])


def test_the_schema_is_one():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


def test_the_command_prints_the_schema(capsys):
    assert cli.main(["scene", "schema"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed.pop("$schema").endswith("/2020-12/schema") and printed.pop("title")
    assert printed == SCHEMA


@pytest.mark.parametrize("name", names())
def test_shipped_scenes_are_valid(name):
    VALIDATOR.validate(tree(name))


LINK = {"inertia": {"xx": 1.0, "yy": 1.0, "zz": 1.0}}


@pytest.mark.parametrize(
    ("key", "value", "path"),
    [
        ("colour", "red", []),
        ("name", " ", ["name"]),
        ("duration", "1 s", ["duration"]),
        ("duration", 0, ["duration"]),
        ("duration", None, ["duration"]),
        ("base", {"v": [[1, 0, 0], [0, 1, 0]], "radius": 1}, ["base", "v"]),
        ("base", {"radius": 1}, ["base"]),
        ("actuated_links", [LINK, LINK], ["actuated_links"]),
        ("intermediate_links", [{"mass": -1}], ["intermediate_links", 0, "mass"]),
        ("stroke", {"at_end": "bounce"}, ["stroke", "at_end"]),
        ("stroke", {"at_end": "elastic", "restitution": 2}, ["stroke", "restitution"]),
        ("moment", {"topic": "yes"}, ["moment", "topic"]),
        (
            "springs",
            [{"joint": "mu_1", "stiffness": 0, "rest": 0}],
            ["springs", 0, "stiffness"],
        ),
        ("friction", {"gamma_1": {}}, ["friction"]),
        ("provenance", {"base": 3}, ["provenance", "base"]),
    ],
)
def test_bad_documents_are_refused_where_they_are_bad(key, value, path):
    errors = list(VALIDATOR.iter_errors({**tree(), key: value}))
    assert [list(error.absolute_path) for error in errors] == [path]


def keys(schema):
    """Names and schemas of all keys."""
    for name, entry in schema.get("properties", {}).items():
        yield name, entry
        yield from keys(entry)
        yield from keys(entry.get("items", {}))


def test_every_key_is_described_with_its_unit():
    friction = SCHEMA["properties"]["friction"]["properties"]["gamma"]["properties"]
    assert friction["viscous"]["description"] == "viscous coefficient [N m s/rad]"
    assert friction["smoothing"]["default"] == 0.01
    assert [name for name, entry in keys(SCHEMA) if not entry.get("description")] == []
