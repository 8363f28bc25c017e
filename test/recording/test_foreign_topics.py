# SPDX-License-Identifier: Apache-2.0
"""Bags with more than one run of ours in them: other robots, other nodes, other
drivers.
"""

import dataclasses

import numpy as np
import pytest

from sst_ros import __main__ as cli
from sst_ros import read_bag
from sst_ros.errors import InputError
from sst_ros.recording import recording
from sst_ros.recording.recording import read_signals
from sst_ros.scene import scene, yaml_document

GRIPPER = ["finger", "thumb"]


def foreign_joints(bags, stamp_ns, names=GRIPPER):
    """A JointState of another robot."""
    numbers = np.full(len(names), 0.01)
    fields = {"position": numbers, "velocity": numbers, "effort": numbers}
    return bags.make(
        "sensor_msgs/JointState", header=bags.header(stamp_ns), name=names, **fields
    )


def at_topic(bags, monkeypatch, topic, like, entries):
    """Copies of messages under another name of a topic."""
    monkeypatch.setitem(bags.KINDS, topic, bags.KINDS[like])
    return [dataclasses.replace(entry, topic=topic) for entry in entries]


def of_topic(entries, topic):
    return [entry for entry in entries if entry.topic == topic]


def later(entries, ns):
    return [
        dataclasses.replace(one, received_ns=one.received_ns + ns) for one in entries
    ]


def test_a_gripper_on_joint_states_is_ignored_and_counted(read, bags, example2):
    """It publishes before the run, in it, and at the stamp of a sample."""
    stamps = [bags.START_NS + k * 50_000_000 for k in range(-2, 5)]
    fingers = [bags.Entry(bags.JOINTS, s + 7, foreign_joints(bags, s)) for s in stamps]
    run = read([*example2, *fingers])
    bags.same(run, read(example2))
    assert (run.foreign_states, run.idle_states) == (7, 3)


@pytest.mark.parametrize("sqlite", [False, True])
def test_topics_are_those_of_the_node_that_publishes_the_scene(
    read, bags, example2, monkeypatch, sqlite
):
    """`ros2 bag record -a` beside ros2_control: the last words of the names are the
    same.
    """
    late = later(of_topic(example2, bags.JOINTS), 13)
    beside = at_topic(
        bags, monkeypatch, "/joint_state_broadcaster/joint_states", bags.JOINTS, late
    )
    commands = later(of_topic(example2, bags.COMMANDS), 17)
    beside += at_topic(
        bags, monkeypatch, "/effort_controller/commands", bags.COMMANDS, commands
    )
    text = bags.make("std_msgs/String", data="a drawing, and no scene")
    monkeypatch.setitem(bags.KINDS, "/monitor/scene", bags.KINDS[bags.SCENE])
    beside.append(bags.Entry("/monitor/scene", bags.START_NS, text))
    imu = of_topic(example2, bags.ORIENTATION)[:40]
    beside += at_topic(bags, monkeypatch, "/imu/orientation", bags.ORIENTATION, imu)
    bags.same(read([*example2, *beside], sqlite=sqlite), read(example2))


def test_joint_states_of_another_node_are_no_substitute(
    read, bags, example2, monkeypatch
):
    name = "/joint_state_broadcaster/joint_states"
    moved = at_topic(
        bags, monkeypatch, name, bags.JOINTS, of_topic(example2, bags.JOINTS)
    )
    with pytest.raises(
        InputError, match=f"joint_states = '{name}': no such topic is of /"
    ):
        read([*bags.without(example2, bags.JOINTS), *moved])


def test_a_reference_of_another_controller_is_not_the_runs(
    read, bags, example2, monkeypatch
):
    sent = bags.tracked(
        example2, lambda t: (np.full(3, 0.7 + 0.1 * t), np.full(3, 0.1))
    )
    stamps = [bags.START_NS + k * 50_000_000 for k in range(5)]
    name = "/arm_controller/reference"
    monkeypatch.setitem(bags.KINDS, name, bags.KINDS[bags.DESIRED])
    arm = [bags.Entry(name, s, foreign_joints(bags, s)) for s in stamps]
    found = read([*sent, *arm]).signals
    assert found.bag.topics["reference"] == bags.DESIRED
    assert len(found.topic_series["reference"]) == 151


@pytest.fixture
def two_robots(bags, example2, tmp_path, monkeypatch):
    """One bag of two runs: that of the namespace /right is another scene."""
    other = bags.simulated(scene.load("example1"), 0.2)
    both = []
    for space, entries in ("/left", example2), ("/right", other):
        for entry in entries:
            name = (
                entry.topic if entry.topic == bags.DIAGNOSTICS else space + entry.topic
            )
            monkeypatch.setitem(bags.KINDS, name, bags.KINDS[entry.topic])
            content = entry.content
            if entry.topic == bags.DIAGNOSTICS:
                (status,) = content.status
                named = dataclasses.replace(status, name=space + status.name)
                content = dataclasses.replace(content, status=[named])
            both.append(dataclasses.replace(entry, topic=name, content=content))
    both.sort(key=lambda entry: entry.received_ns)
    return bags.write(tmp_path / "two", both)


def test_two_robots_in_a_bag_are_told_apart_by_their_namespaces(
    two_robots, read, bags, example2
):
    with pytest.raises(
        InputError, match=r"namespace = None: must be one of /left, /right"
    ):
        read_bag(two_robots)
    with pytest.raises(
        InputError, match=r"namespace = 'middle': must be one .*: /left, /right"
    ):
        read_bag(two_robots, namespace="middle")
    with pytest.raises(InputError, match=r"namespace = 7: must be text"):
        read_bag(two_robots, namespace=7)
    bags.same(read_bag(two_robots, namespace="left"), read(example2))
    right = read_bag(two_robots, namespace="/right/")
    assert right.scene.name == "example1" and right.diagnostics["phase"] == "finished"
    assert right.signals.namespace == "/right"


@pytest.mark.slow
def test_commands_read_the_run_of_a_namespace(two_robots, tmp_path, capsys):
    words = {
        "export": ["--out", str(tmp_path / "tables")],
        "report run": ["--out", str(tmp_path / "report")],
        "plot": ["--only", "torques", "--out", str(tmp_path / "plots")],
        "identify": ["--parameters", "star.inertia"],
    }
    for command, more in words.items():
        line = [*command.split(), str(two_robots), *more]
        assert cli.main(line) == 1
        assert "must be one of /left, /right" in capsys.readouterr().err
        assert cli.main([*line, "--namespace", "/right"]) == 0, capsys.readouterr().err
    assert "example1" in (tmp_path / "report" / "summary.json").read_text()


def test_a_run_of_a_namespace_is_followed(two_robots, tmp_path, capsys):
    path = tmp_path / "again.yaml"
    for namespace, status in ({}, 1), ({"namespace": "/right"}, 0):
        recorded = {"bag": str(two_robots), **namespace}
        following = {"torque": None, "motion": {"recorded": recorded}}
        changed = scene.load("example1").with_values(following)
        path.write_text(yaml_document.dump(changed), encoding="utf-8")
        assert cli.main(["plan", "check", str(path)]) == status
    assert "must be one of /left, /right" in capsys.readouterr().err


def test_two_robots_in_one_bag_are_compared(two_robots, tmp_path, capsys):
    line = [
        "compare",
        str(two_robots),
        "--only",
        "torques",
        "--out",
        str(tmp_path / "compared"),
    ]
    assert cli.main([*line, "--namespace", "/left", "/right"]) == 0
    said = capsys.readouterr().out
    assert "/left" in said and "/right: 101 of 101 samples" in said


def test_two_simulators_in_one_namespace_are_refused(read, bags, example2, monkeypatch):
    again = []
    for entry in example2:
        name = entry.topic.replace("sst_simulator", "second")
        if name != entry.topic:
            again += at_topic(bags, monkeypatch, name, entry.topic, [entry])
    with pytest.raises(
        InputError, match=r"scene = '/second, /sst_simulator': .* one namespace"
    ):
        read([*example2, *again])


def test_a_bag_of_foreign_topics_says_what_it_has(written, bags, monkeypatch):
    kind = bags.KINDS[bags.DESIRED]
    monkeypatch.setitem(bags.KINDS, "/arm/joint_positions", kind)
    one = bags.Entry(
        "/arm/joint_positions", bags.START_NS, foreign_joints(bags, bags.START_NS)
    )
    for sqlite in (False, True):
        path = written([one], sqlite=sqlite)
        with pytest.raises(
            InputError, match=r"topics = '/arm/joint_positions': must have"
        ):
            read_signals(path)


def strip(message, joints, *empty):
    """The first joints of a message alone, with fields that are empty."""
    fields = {
        name: getattr(message, name)[:joints]
        for name in ("position", "velocity", "effort")
    }
    fields |= {name: np.empty(0) for name in empty}
    return dataclasses.replace(message, name=message.name[:joints], **fields)


def test_joint_states_as_drivers_send_them_are_a_table(
    written, bags, example2, tmp_path
):
    """Angles of the actuators alone: no passive joints, no velocities, no efforts."""
    pd = pytest.importorskip("pandas")
    bare = bags.edited(
        example2, bags.JOINTS, None, lambda one: strip(one, 3, "velocity", "effort")
    )
    path = written([one for one in bare if one.topic == bags.JOINTS])
    recording.export(path, tmp_path / "out")
    table = pd.read_csv(tmp_path / "out" / "samples.csv")
    assert len(table) == 151 and np.isfinite(
        table[[f"gamma_{k}_rad" for k in (1, 2, 3)]]
    ).all(axis=None)
    unknown = [
        n
        for n in table
        if n.endswith(("rad_per_s", "N_m")) or n.startswith(("mu", "beta"))
    ]
    assert len(unknown) == 18 and table[unknown].isna().all(axis=None)


@pytest.mark.parametrize(
    ("joints", "empty", "said"),
    [
        (9, ("velocity",), "no gamma_dot_1..3, mu_dot_1..3, beta_dot_1..3'"),
        (9, ("effort",), "no tau_1..3'"),
        (
            3,
            ("effort",),
            "no mu_1..3, beta_1..3, mu_dot_1..3, beta_dot_1..3, tau_1..3'",
        ),
    ],
)
def test_what_is_missing_for_a_whole_run_is_said(
    read, bags, example2, joints, empty, said
):
    bare = bags.edited(
        example2, bags.JOINTS, None, lambda one: strip(one, joints, *empty)
    )
    with pytest.raises(
        InputError, match=f"joint_states = '{said}: must have these: a whole run"
    ):
        read(bare)
