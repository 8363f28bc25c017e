# SPDX-License-Identifier: Apache-2.0
"""What a whole bag gives, as a motion to follow too, and that every broken one is
refused.
"""

import contextlib
import copy
import dataclasses
import sqlite3

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode

import sst_ros
from sst_ros import __main__ as cli
from sst_ros.control.plan import examine_motion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import InputError
from sst_ros.recording import recording
from sst_ros.recording.bag_reader import Bag
from sst_ros.recording.recording import read_run_motion
from sst_ros.scene import scene, yaml_document
from sst_ros.scene.loads import DesiredMotion, Recorded


def test_a_run_comes_back_as_it_was_written(read, bags, example2):
    run = read(example2)
    assert run.scene == scene.load("example2")
    assert run.start_ns == bags.START_NS
    assert np.array_equal(run.time_ns, np.arange(151) * 2_000_000)
    assert np.array_equal(run.ticks.start_ns, np.arange(300) * 1_000_000)
    assert np.array_equal(run.ticks.end_ns, run.ticks.start_ns + 1_000_000)
    assert (run.period_ns, run.ticks.period_ns, run.ticks.gaps) == (
        2_000_000,
        1_000_000,
        0,
    )
    assert np.array_equal(run.received_ns - run.start_ns, run.time_ns + 50_000)
    assert (run.idle_states, len(run.commands.torque), run.missing) == (3, 1, ())
    assert run.diagnostics["phase"] == "finished"
    assert run.signals.bag.topics["orientation"] == "/sst_simulator/orientation"
    last = next(
        e.content for e in example2 if (e.topic, e.sample) == (bags.JOINTS, 150)
    )
    sections = [run.gamma, run.mu, run.beta], [run.gamma_dot, run.mu_dot, run.beta_dot]
    assert np.array_equal(
        np.concatenate([part[150] for part in sections[0]]), last.position
    )
    assert np.array_equal(
        np.concatenate([part[150] for part in sections[1]]), last.velocity
    )
    assert np.array_equal(run.effort[150], last.effort[:3])
    assert np.array_equal(run.effort[1:], run.ticks.torque[1::2])
    assert np.isfinite(run.euler).all() and np.isfinite(run.quaternion).all()


def test_joints_are_found_by_name(read, bags, example2):
    order = [4, 8, 0, 2, 1, 3, 7, 6, 5]

    def shuffled(message):
        fields = {
            f: getattr(message, f)[order] for f in ("position", "velocity", "effort")
        }
        return dataclasses.replace(
            message, name=[message.name[i] for i in order], **fields
        )

    bags.same(read(bags.edited(example2, bags.JOINTS, 70, shuffled)), read(example2))


def test_topics_that_are_not_essential_may_be_missing(read, bags, example2):
    run = read(bags.without(example2, bags.EULER, bags.DIAGNOSTICS, bags.COMMANDS))
    assert set(run.missing) == {"euler_zyz", "diagnostics", "commands"}
    assert np.isnan(run.euler).all() and run.diagnostics == {}


@pytest.mark.parametrize(
    "topic", ["joint_states", "orientation", "applied_torques", "scene"]
)
def test_a_missing_essential_topic_is_named(read, bags, example2, topic):
    gone = [name for name in bags.KINDS if name.endswith(f"/{topic}")]
    with pytest.raises(
        InputError, match=f"{topic} = None: no topic of type .* ends in /{topic}"
    ):
        read(bags.without(example2, *gone))


def test_what_is_no_bag_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"nowhere.*does not exist"):
        recording.read(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty.*metadata"):
        recording.read(tmp_path / "empty")
    for name in ("notes.txt", "noise.mcap", "noise.db3"):
        (tmp_path / name).write_bytes(bytes(range(256)) * 20)
        with pytest.raises(InputError, match=f"{name}.*rosbag2"):
            recording.read(tmp_path / name)


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_database_is_refused(written, example2, kept):
    """Those in MCAP are in test_damage.py."""
    path = written(example2, sqlite=True)
    (file,) = path.glob("*.db3")
    whole = file.read_bytes()
    file.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(InputError, match=r"bag.*must be a whole rosbag2 recording"):
        recording.read(path)


def test_garbled_bytes_never_give_a_traceback(written, bags, example2):
    path = written(example2)
    (file,) = path.glob("*.mcap")
    whole = file.read_bytes()
    generator = np.random.default_rng(2)
    outcomes = []
    for at in generator.integers(0, len(whole) - 64, 25):
        noise = generator.integers(0, 256, 64, dtype=np.uint8).tobytes()
        file.write_bytes(whole[:at] + noise + whole[at + 64 :])
        try:
            outcomes.append(recording.read(path))
        except InputError as error:
            outcomes.append(error)
    assert any(isinstance(outcome, InputError) for outcome in outcomes)


def test_a_run_that_never_started_or_ends_at_once_says_so(read, bags, example2):
    with pytest.raises(InputError, match=r"joint_states = 0: .*3 lie before its start"):
        read([entry for entry in example2 if entry.sample < 0])
    first = [
        entry
        for entry in example2
        if entry.sample < 1 and entry.topic != bags.DIAGNOSTICS
    ]
    why = bags.diagnostics_entry(
        bags.START_NS, phase="fault", fault="stopped: gamma_1 < 0"
    )
    with pytest.raises(InputError, match=r"joint_states = 1: .*stopped: gamma_1 < 0"):
        read([*first, why])


AT = 1_700_000_000_123_456_789 + 140_000_000
CONTENTS = [
    (
        "JOINTS",
        "velocity",
        np.full(9, np.nan),
        f"joint_states.*not finite at stamp {AT}",
    ),
    ("JOINTS", "effort", np.zeros(3), "equally long"),
    ("JOINTS", "name", ["a", "mu_1"], "joints are missing: gamma_1"),
    (
        "JOINTS",
        "header.stamp",
        -140_000_000,
        f"stamp {AT - 140_000_000} ns comes twice",
    ),
    ("ORIENTATION", "quaternion.w", 3.0, "orientation.*must have length 1"),
    (
        "APPLIED",
        "joint_names",
        ["a", "b", "c"],
        "applied_torques.*gamma_1, gamma_2, gamma_3",
    ),
    ("APPLIED", "header.stamp", -2_500_000, "ticks overlap"),
    (
        "SCENE",
        "data",
        ("radius: 0.4", "radius: -0.4"),
        "scene: .*star.radius.*>= 1e-12",
    ),
]


@pytest.mark.parametrize(("topic", "attribute", "value", "said"), CONTENTS)
def test_contents_that_cannot_be_are_refused(
    read, bags, example2, topic, attribute, value, said
):
    def change(message):
        result, (*parents, last) = copy.deepcopy(message), attribute.split(".")
        owner = getattr(result, parents[0]) if parents else result
        new = bags.time(AT + value) if last == "stamp" else value
        if topic == "SCENE":
            new = message.data.replace(*value)
        object.__setattr__(owner, last, new)
        return result

    sample = -1 if topic == "SCENE" else 70
    with pytest.raises(InputError, match=f"(?s){said}"):
        read(bags.edited(example2, getattr(bags, topic), sample, change))


def test_bags_of_every_kind_hold_the_same_run(read, tmp_path, bags, example2):
    expected = recording.read(bags.record(tmp_path / "own", example2))
    bags.same(recording.read(tmp_path / "own" / "own.mcap"), expected)
    modes = (CompressionMode.STORAGE, CompressionMode.MESSAGE, CompressionMode.FILE)
    kinds = [{}, {"sqlite": True}, {"chunks": ("lz4", lz4.frame.compress)}]
    kinds += [{"mode": mode, "sqlite": True} for mode in modes[1:]]
    for kind in (*kinds, *({"mode": mode} for mode in modes)):
        run = read(example2, namespace="/cell_7", **kind)
        bags.same(run, expected)
        assert run.signals.bag.topics["joint_states"] == "/cell_7/joint_states"


def test_diagnostics_of_another_simulator_are_not_the_runs(read, bags, example2):
    """/diagnostics is one topic for all; the other one ends later."""
    other = bags.diagnostics_entry(
        example2[-1].received_ns + 1, phase="running", ticks=7
    )
    (status,) = other.content.status
    renamed = dataclasses.replace(status, name="/right/sst_simulator: run")
    content = dataclasses.replace(other.content, status=[renamed])
    run = read([*example2, dataclasses.replace(other, content=content)])
    assert (
        run.reports == read(example2).reports and run.diagnostics["phase"] == "finished"
    )


@pytest.mark.parametrize("encoding", ["", "unknown"])
def test_a_database_with_an_action_is_whole(written, bags, example2, encoding):
    """`ros2 bag record -a -s sqlite3` leaves an action's type definitions empty."""
    path, name = written(example2, sqlite=True), "/fibonacci/_action/feedback"
    kind = "example_interfaces/action/Fibonacci_FeedbackMessage"
    (file,) = path.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as database, database:
        topic = "INSERT INTO topics VALUES (?, ?, ?, 'cdr', '', '')"
        database.execute(topic, (99, name, kind))
        definition = "INSERT INTO message_definitions VALUES (?, ?, ?, '', '')"
        database.execute(definition, (99, kind, encoding))
        message = "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)"
        database.execute(message, (99, bags.START_NS, bytes(32)))
    bags.same(recording.read(path), recording.read(written(example2)))
    bags.same(recording.read(file), recording.read(path))


def test_idle_states_are_no_samples(read, bags, example2):
    """They are marked in their frame; those of older recordings have the stamp zero."""
    header = dataclasses.replace(bags.header(bags.START_NS - 5), frame_id="idle")
    marked = bags.edited(
        example2,
        bags.JOINTS,
        -1,
        lambda message: dataclasses.replace(message, header=header),
    )
    run = read(marked)
    bags.same(run, read(example2))
    assert run.idle_states == 3


def test_a_recording_is_read_in_one_pass(read, example2, monkeypatch):
    """All tables, the tracking error and the figures of the report come from one
    reading.
    """
    passes, messages = [], Bag.messages
    monkeypatch.setattr(
        Bag, "messages", lambda bag: passes.append(bag) or messages(bag)
    )
    run = read(example2)
    assert (
        set(run.signals.tables) == {"samples", "ticks", "commands"}
        and run.ticks.period_ns
    )
    assert len(passes) == 1


def test_a_recording_is_a_trajectory_and_tables(example2_bag):
    pytest.importorskip("pandas")
    run = sst_ros.read_bag(example2_bag)
    motion = run.trajectory
    assert isinstance(run, sst_ros.Recording) and isinstance(motion, sst_ros.Trajectory)
    assert np.array_equal(motion.gamma, run.gamma) and np.array_equal(
        motion.torque, run.effort
    )
    assert (
        motion.success and motion.error_estimate == 1e-12 and motion.method == "dopri5"
    )
    simulation = sst_ros.Simulation(run.scene)
    for tick in range(151):
        simulation.step(tuple(run.ticks.torque[tick].tolist()), 1_000_000)
    between = motion.at(0.151)  # between two samples, in the middle of a held torque
    assert between.gamma[0] == pytest.approx(simulation.state.joints.gamma, abs=1e-12)
    table = run.table("ticks")
    assert (
        np.array_equal(table["tau_1_N_m"], run.ticks.torque[:, 0])
        and table.index[0] == 0
    )


def following(bag):
    motion = DesiredMotion(recorded=Recorded(bag=str(bag)))
    return dataclasses.replace(scene.load("example2"), motion=motion)


def test_inverse_dynamics_of_a_recording_are_its_torques(
    example2_bag,
):
    """Held for 1 ms they are a staircase.

    The smooth motion asks for what lies between.
    """
    run, held = recording.read(example2_bag), following(example2_bag)
    plan = examine_motion(reference_motion(held, read_run_motion), held)
    assert plan.motion.duration == pytest.approx(run.seconds[-1], abs=1e-12)
    for row in (0, 40, len(run.gamma) - 1):
        at = plan.motion.at(run.seconds[row])
        assert at.gamma == pytest.approx(run.gamma[row], abs=1e-13)
        assert at.gamma_dot == pytest.approx(run.gamma_dot[row], abs=1e-11)
        assert at.quaternion == pytest.approx(run.quaternion[row], abs=1e-12)
    torque = held.torque.at
    # What is held since the last millisecond lags behind the sine by half of one.
    expected = np.array([torque(time - 0.0005) for time in plan.trajectory.t.tolist()])
    inside = (plan.trajectory.t > 0.02) & (
        plan.trajectory.t < plan.motion.duration - 0.02
    )
    half_a_step = 0.0005 * np.max(
        np.multiply(held.torque.amplitude, held.torque.frequency)
    )
    assert np.abs(plan.trajectory.torque - expected)[inside].max() < half_a_step
    assert np.abs(expected).max() > 100.0 * half_a_step


def test_the_command_reads_the_bag(example2_bag, tmp_path, capsys):
    path = tmp_path / "again.yaml"
    path.write_text(yaml_document.dump(following(example2_bag)), encoding="utf-8")
    assert cli.main(["plan", "check", str(path)]) == 0
    assert "At any speed: the scene has no limit" in capsys.readouterr().out


def test_what_is_no_motion_of_the_manipulator_is_refused(example2_bag, tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        reference_motion(following(tmp_path / "nowhere"), read_run_motion)
    other = dataclasses.replace(
        scene.load("general"), motion=following(example2_bag).motion
    )
    with pytest.raises(Exception, match="does not close the loops"):
        reference_motion(other, read_run_motion)
