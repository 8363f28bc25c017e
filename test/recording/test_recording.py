# SPDX-License-Identifier: Apache-2.0
"""Reading bags: what a whole one gives, and that every broken one is refused in words."""

import copy
import dataclasses

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

import sst_ros
from sst_ros.errors import InputError
from sst_ros.recording import recording
from sst_ros.scene import scene


def test_a_run_comes_back_as_it_was_written(written, bags, example2):
    run = recording.read(written(example2))
    assert run.scene == scene.load("example2")
    assert run.start_ns == bags.START_NS
    assert np.array_equal(run.time_ns, np.arange(151) * 2_000_000)
    assert np.array_equal(run.ticks.start_ns, np.arange(300) * 1_000_000)
    assert np.array_equal(run.ticks.end_ns, run.ticks.start_ns + 1_000_000)
    assert (run.period_ns, run.ticks.period_ns, run.ticks.gaps) == (2_000_000, 1_000_000, 0)
    assert np.array_equal(run.received_ns - run.start_ns, run.time_ns + 50_000)
    assert (run.idle_states, len(run.commands.torque), run.missing) == (3, 1, ())
    assert run.diagnostics["phase"] == "finished"
    assert run.signals.topics["orientation"] == "/sst_simulator/orientation"
    last = next(e.content for e in example2 if (e.topic, e.sample) == (bags.JOINTS, 150))
    sections = [run.gamma, run.mu, run.beta], [run.gamma_dot, run.mu_dot, run.beta_dot]
    assert np.array_equal(np.concatenate([part[150] for part in sections[0]]), last.position)
    assert np.array_equal(np.concatenate([part[150] for part in sections[1]]), last.velocity)
    assert np.array_equal(run.effort[150], last.effort[:3])
    assert np.array_equal(run.effort[1:], run.ticks.torque[1::2])
    assert np.isfinite(run.euler).all() and np.isfinite(run.quaternion).all()


def test_joints_are_found_by_name(tmp_path, bags, example2):
    order = [4, 8, 0, 2, 1, 3, 7, 6, 5]

    def shuffled(message):
        names = [message.name[i] for i in order]
        fields = {f: getattr(message, f)[order] for f in ("position", "velocity", "effort")}
        return bags.make("sensor_msgs/JointState", header=message.header, name=names, **fields)

    mixed = bags.edited(example2, bags.JOINTS, 70, shuffled)
    plain = recording.read(bags.write(tmp_path / "a", example2))
    other = recording.read(bags.write(tmp_path / "b", mixed))
    for name in ("gamma", "mu", "beta", "gamma_dot", "mu_dot", "beta_dot", "effort"):
        assert np.array_equal(getattr(plain, name), getattr(other, name))


def test_sqlite_single_files_and_namespaces_are_read(tmp_path, bags, example2):
    plain = recording.read(bags.write(tmp_path / "a", example2))
    other = recording.read(bags.write(tmp_path / "b", example2, sqlite=True, namespace="/cell_7"))
    assert np.array_equal(plain.gamma, other.gamma)
    assert other.signals.topics["joint_states"] == "/cell_7/joint_states"
    single = recording.read(next((tmp_path / "a").glob("*.mcap")))
    assert np.array_equal(plain.ticks.torque, single.ticks.torque)


def test_topics_that_are_not_essential_may_be_missing(written, bags, example2):
    run = recording.read(
        written(bags.without(example2, bags.EULER, bags.DIAGNOSTICS, bags.COMMANDS))
    )
    assert set(run.missing) == {"euler_zyz", "diagnostics", "commands"}
    assert np.isnan(run.euler).all() and run.diagnostics == {}


@pytest.mark.parametrize("topic", ["joint_states", "orientation", "applied_torques", "scene"])
def test_a_missing_essential_topic_is_named(written, bags, example2, topic):
    gone = [name for name in bags.KINDS if name.endswith(f"/{topic}")]
    with pytest.raises(InputError, match=f"{topic} = None: no topic of type .* ends in /{topic}"):
        recording.read(written(bags.without(example2, *gone)))


def test_two_matching_topics_are_refused(tmp_path, bags, example2):
    bags.KINDS["/other/joint_states"] = bags.KINDS[bags.JOINTS]
    extra = [e for e in example2 if e.topic == bags.JOINTS][:5]
    extra = [bags.Entry("/other/joint_states", e.received_ns, e.content) for e in extra]
    try:
        path = bags.write(tmp_path / "bag", [*example2, *extra])
    finally:
        del bags.KINDS["/other/joint_states"]
    with pytest.raises(InputError, match=r"/joint_states, /other/joint_states.*only one topic"):
        recording.read(path)


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


@pytest.mark.parametrize("sqlite", [False, True])
@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_bag_is_refused(written, bags, example2, sqlite, kept):
    path = written(example2, sqlite=sqlite)
    (file,) = [*path.glob("*.mcap"), *path.glob("*.db3")]
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


def test_a_run_that_never_started_is_refused(written, example2):
    previews = [entry for entry in example2 if entry.sample < 0]
    with pytest.raises(InputError, match=r"joint_states = 0: .*3 lie before its start"):
        recording.read(written(previews))


def test_a_run_that_ends_at_once_tells_why(written, bags, example2):
    first = [entry for entry in example2 if entry.sample < 1 and entry.topic != bags.DIAGNOSTICS]
    told = bags.diagnostics_entry(bags.START_NS, phase="fault", fault="stopped: gamma_1 < 0")
    with pytest.raises(InputError, match=r"joint_states = 1: .*stopped: gamma_1 < 0"):
        recording.read(written([*first, told]))


def _changed(message, **paths):
    """Copy a message with attributes set; `header__stamp` stands for header.stamp."""
    result = copy.deepcopy(message)
    for path, value in paths.items():
        *parents, last = path.split("__")
        owner = result
        for parent in parents:
            owner = getattr(owner, parent)
        object.__setattr__(owner, last, value)
    return result


def test_contents_that_cannot_be_are_refused(tmp_path, bags, example2):
    def refusal(topic, change):
        path = tmp_path / str(len(list(tmp_path.iterdir())))
        with pytest.raises(InputError) as caught:
            recording.read(bags.write(path, bags.edited(example2, topic, 70, change)))
        return str(caught.value)

    nan = np.full(9, np.nan)
    said = refusal(bags.JOINTS, lambda m: _changed(m, velocity=nan))
    assert "joint_states" in said and f"not finite at stamp {bags.START_NS + 140_000_000}" in said
    said = refusal(bags.JOINTS, lambda m: _changed(m, effort=np.zeros(3)))
    assert "equally long" in said
    said = refusal(bags.JOINTS, lambda m: _changed(m, name=["a", *m.name[1:]]))
    assert "joints are missing: gamma_1" in said
    said = refusal(bags.JOINTS, lambda m: _changed(m, header__stamp=bags.time(bags.START_NS)))
    assert f"stamp {bags.START_NS} ns comes twice" in said
    said = refusal(bags.ORIENTATION, lambda m: _changed(m, quaternion__w=3.0))
    assert "orientation" in said and "must have length 1" in said
    said = refusal(bags.APPLIED, lambda m: _changed(m, joint_names=["a", "b", "c"]))
    assert "applied_torques" in said and "gamma_1, gamma_2, gamma_3" in said
    early = bags.time(bags.START_NS + 137_500_000)
    said = refusal(bags.APPLIED, lambda m: _changed(m, header__stamp=early))
    assert "ticks overlap" in said


def test_a_scene_that_is_refused_names_topic_and_key(written, bags, example2):
    def broken(entry):
        text = entry.content.data.replace("radius: 0.4", "radius: -0.4")
        return bags.Entry(bags.SCENE, entry.received_ns, bags.make("std_msgs/String", data=text))

    entries = [broken(e) if e.topic == bags.SCENE else e for e in example2]
    with pytest.raises(InputError, match=r"/sst_simulator/scene: .*star.radius.*> 0"):
        recording.read(written(entries))


def _compressed(path, entries, bags, mode=None, compressor=None):
    """Write a bag that is compressed as rosbag2 does it, or in chunks of some other kind."""
    connections = {}
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        if compressor is not None:
            writer.storage.compression, writer.storage.compressor = compressor
        for entry in entries:
            if entry.topic not in connections:
                kind = bags.KINDS[entry.topic]
                connections[entry.topic] = writer.add_connection(
                    entry.topic, kind, typestore=bags.STORE
                )
            raw = bytes(bags.STORE.serialize_cdr(entry.content, entry.content.__msgtype__))
            writer.write(connections[entry.topic], entry.received_ns, raw)
    return path


def _same(one, other):
    arrays = {name: mine for name, mine in vars(one).items() if isinstance(mine, np.ndarray)}
    assert len(arrays) == 11
    for name, mine in arrays.items():
        assert np.array_equal(mine, getattr(other, name), equal_nan=True), name
    assert np.array_equal(one.ticks.torque, other.ticks.torque)
    assert np.array_equal(one.commands.torque, other.commands.torque)
    assert one.scene == other.scene and one.reports == other.reports


def test_bags_of_every_kind_hold_the_same_run(tmp_path, bags, example2):
    expected = recording.read(bags.record(tmp_path / "own", example2))
    _same(recording.read(bags.write(tmp_path / "plain", example2)), expected)
    _same(recording.read(bags.write(tmp_path / "sqlite", example2, sqlite=True)), expected)
    packed = ("lz4", lz4.frame.compress)
    _same(
        recording.read(_compressed(tmp_path / "lz4", example2, bags, compressor=packed)), expected
    )
    for mode in (CompressionMode.STORAGE, CompressionMode.MESSAGE, CompressionMode.FILE):
        path = _compressed(tmp_path / str(mode), example2, bags, mode)
        _same(recording.read(path), expected)


def test_idle_states_are_no_samples(tmp_path, bags, example2):
    """They are marked in their frame; those of older recordings have the stamp zero."""

    def marked(entry):
        if entry.topic != bags.JOINTS or entry.sample >= 0:
            return entry
        header = bags.make("std_msgs/Header", stamp=bags.time(bags.START_NS - 5), frame_id="idle")
        content = dataclasses.replace(entry.content, header=header)
        return dataclasses.replace(entry, content=content)

    plain = recording.read(bags.write(tmp_path / "plain", example2))
    run = recording.read(bags.write(tmp_path / "marked", [marked(entry) for entry in example2]))
    _same(run, plain)
    assert run.idle_states == plain.idle_states == 3


def test_a_recording_is_read_in_one_pass(tmp_path, bags, example2, monkeypatch):
    """All tables, the tracking error and the figures of the report come from one reading."""
    from sst_ros.recording import bag_reader

    count = 0
    messages = bag_reader.Bag.messages

    def counted(bag):
        nonlocal count
        count += 1
        return messages(bag)

    monkeypatch.setattr(bag_reader.Bag, "messages", counted)
    run = recording.read(bags.write(tmp_path / "bag", example2))
    assert set(run.signals.tables) == {"samples", "ticks", "commands"} and run.ticks.period_ns
    assert count == 1


def test_a_recording_is_a_trajectory_and_tables(tmp_path, bags, example2):
    pytest.importorskip("pandas")
    run = sst_ros.read_bag(bags.write(tmp_path / "bag", example2))
    motion = run.trajectory
    assert isinstance(run, sst_ros.Recording) and isinstance(motion, sst_ros.Trajectory)
    assert np.array_equal(motion.gamma, run.gamma) and np.array_equal(motion.torque, run.effort)
    assert motion.success and motion.error_estimate == 1e-12 and motion.method == "dopri5"
    simulation = sst_ros.Simulation(run.scene)
    for tick in range(151):
        simulation.step(tuple(run.ticks.torque[tick].tolist()), 1_000_000)
    between = motion.at(0.151)  # between two samples, in the middle of a held torque
    assert between.gamma[0] == pytest.approx(simulation.state.joints.gamma, abs=1e-12)
    table = run.table("ticks")
    assert np.array_equal(table["tau_1_N_m"], run.ticks.torque[:, 0]) and table.index[0] == 0
