# SPDX-License-Identifier: Apache-2.0
"""The state machine of a run, in a thread of its own, without ROS."""

import contextlib
import threading
import time
from functools import partial
from types import SimpleNamespace as Box

import numpy as np
import pytest

from sst_ros import load_scene
from sst_ros.errors import RunStopped
from sst_ros.integration import codegen
from sst_ros.mechanism.generic_math import ZERO
from sst_ros.nodes.simulation_interfaces import SimulationInterfaces
from sst_ros.runtime.diagnostics import OK, WARN, RunDiagnostics
from sst_ros.runtime.pacing import Pacer, SteadyTime
from sst_ros.runtime.run_loop import Phase, Reply, RunLoop
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.torque_input import MOST_WAITING, TorqueInput
from sst_ros.simulation.simulation import Simulation


class Output:
    """Keeps what the run publishes; gives time from 1 s on."""

    def __init__(self):
        self.samples, self.acted, self.idles, self.phases = [], [], [], []
        self.flushed, self.unpublished = 0, {}
        self.now, self.missing = 1_000_000_000, []

    def now_ns(self):
        return self.now

    unread = False

    def missing_subscribers(self):
        return self.missing

    def start(self):
        pass

    def ticks(self, torque, moment, count):
        self.acted.extend([torque] * count)

    def sample(self, simulation, stamp_ns):
        self.samples.append((stamp_ns, simulation.state))

    def flush(self):
        self.flushed = len(self.acted)

    def idle(self, state, stamp_ns, *, at_rest):
        self.idles.append((state, at_rest, stamp_ns))

    def publish_phase(self, phase):
        self.phases.append(phase)
        self.unpublished[phase.partition(":")[0]] = len(self.acted) - self.flushed


class Queue(list):
    """Messages that have arrived; with `waiting` the first arrives after the third request."""

    waiting = False

    def __init__(self):
        super().__init__()
        self.asked = []

    def read(self, until_ns):
        self.asked.append(until_ns)
        if self.waiting and len(self.asked) <= 3:
            return ()
        self.waiting = False
        found = self[:MOST_WAITING]
        del self[:MOST_WAITING]
        return found


class Bench:
    def __init__(self, scene="example1", build=Simulation, **given):
        # A busy machine may take long for what is quick: no command is let go of meanwhile.
        given = {"real_time_factor": 0.0, "command_timeout": 0.0, **given}
        parameters = SimulatorParameters(scene=scene, **given)
        run = parameters.run
        self.queue, self.stamped, self.output = Queue(), Queue(), Output()
        self.input = TorqueInput(run, None, self.queue, self.stamped)
        pacer = Pacer(run.period_ns, parameters.real_time_factor, SteadyTime())
        self.loop = RunLoop(load_scene(scene), build, run, self.input, pacer, self.output)
        self.thread = threading.Thread(target=self.loop.run, daemon=True)

    @contextlib.contextmanager
    def running(self):
        self.thread.start()
        try:
            yield self.loop
        finally:
            self.loop.stop()
            self.thread.join(40)
            assert not self.thread.is_alive()

    def begin(self):
        """Answer the state that is shown before a run in lockstep."""
        self.stamped.append(answer(0))
        self.until(lambda: self.output.samples)

    def until(self, condition, timeout=40.0):
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.001)


@contextlib.contextmanager
def running(*args, **given):
    bench = Bench(*args, **given)
    with bench.running() as loop:
        yield bench, loop


def answer(stamp_ns):
    stamp = Box(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    names = ["gamma_1", "gamma_2", "gamma_3"]
    return Box(header=Box(stamp=stamp), name=names, effort=[0.0, 0.0, 0.0])


def stamps(bench):
    return [stamp for stamp, _ in bench.output.samples]


def test_a_run_ends_after_its_duration_with_every_sample():
    bench = Bench(duration=0.0105, publish_rate=250)
    bench.loop.run()
    assert bench.loop.phase is Phase.FINISHED
    first = stamps(bench)[0]
    assert stamps(bench) == [first + k * 1_000_000 for k in (0, 4, 8, 11)]
    assert len(bench.output.acted) == bench.loop.counters.ticks == 11
    assert bench.output.phases == ["waiting", "running", "finished"]


def test_no_torque_is_unpublished_when_a_run_does_not_go_on():
    bench = Bench(duration=0.0105, publish_rate=250)
    bench.loop.run()
    assert bench.output.unpublished["finished"] == 0 < bench.output.flushed == 11

    with running(scene="example2_heavy") as (bench, loop):
        bench.until(lambda: bench.output.acted)
        loop.ask(partial(loop.pause, True))
        assert bench.output.unpublished["paused"] == 0 < bench.output.flushed
        bench.queue.append(Box(data=(50.0, 0.0, 0.0)))
        loop.ask(partial(loop.pause, False))
        bench.until(lambda: loop.phase is Phase.FAULT)
        assert bench.output.unpublished["fault"] == 0

    with running() as (bench, loop):
        bench.until(lambda: bench.output.acted)
        loop.ask(partial(loop.pause, True))
        assert loop.ask(loop.step).success
    assert bench.output.flushed == len(bench.output.acted)  # it ends right after a step


def test_a_run_that_is_stepped_to_its_end_is_finished_and_has_no_fault():
    with running(duration=0.02, real_time_factor=0.01) as (bench, loop):
        bench.until(lambda: bench.output.acted)
        loop.ask(partial(loop.pause, True))
        assert loop.ask(partial(loop.step, 20)).success
        bench.thread.join(10.0)
    assert bench.output.phases[-2:] == ["paused", "finished"]
    assert bench.output.unpublished["finished"] == 0


def test_compiled_ticks_between_samples_are_done_together_and_commands_keep_their_tick():
    """The command comes between the beginnings of two ticks that are done together."""

    class Compiled(Simulation):
        @property
        def compiled(self):  # plain Python here, done together all the same
            return True

        @compiled.setter
        def compiled(self, value):
            pass

    torque = (1.0, 2.0, 3.0)
    bench = Bench(build=Compiled, real_time_factor=1.0, duration=0.02, publish_rate=500)
    bench.queue.append(Box(data=torque))
    bench.queue.waiting = True
    bench.loop.run()
    assert bench.output.acted == 3 * [ZERO] + 17 * [torque]
    first, second = bench.queue.asked[2:4]  # the first two are done alone, to measure them
    assert second - first == 1_000_000


def test_a_free_run_passes_over_samples_that_nothing_receives():
    bench = Bench(duration=0.2, publish_rate=500)
    bench.output.unread = True
    bench.loop.run()
    first, last = stamps(bench)[0], stamps(bench)[-1]
    assert (last - first, bench.loop.counters.ticks) == (200_000_000, 200)
    assert len(stamps(bench)) < bench.loop.counters.published == 101
    simulation = Simulation("example1")
    simulation.steps(ZERO, 1_000_000, 200)
    assert bench.output.samples[-1][1] == simulation.state


def test_a_change_of_method_loads_no_code_inside_a_tick(monkeypatch):
    begun, load = [], codegen.load

    def loading(*args, **named):
        begun.append(bench.loop.begun)
        return load(*args, **named)

    bench = Bench(scene="stiff", duration=0.1)
    monkeypatch.setattr(codegen, "load", loading)
    bench.loop.run()
    assert bench.loop.phase is Phase.FINISHED and bench.loop.simulation.changes
    assert begun and not any(begun)


def test_code_that_takes_long_to_load_is_no_fault():
    class Slow(Simulation):
        def load_code(self, dt_ns):
            end = time.thread_time() + 0.6
            while time.thread_time() < end:
                pass

    bench = Bench(build=Slow, duration=0.01)
    bench.thread.start()
    while bench.thread.is_alive():
        bench.loop.watch()
        time.sleep(0.05)
    assert bench.loop.phase is Phase.FINISHED and not bench.loop.fault


def test_pause_is_idempotent_and_a_step_is_one_sample():
    with running() as (bench, loop):
        bench.until(lambda: len(bench.output.samples) > 3)
        assert loop.ask(loop.step) == (
            False,
            "refused: only a paused run can be stepped, it is running",
        )
        assert loop.ask(partial(loop.pause, True)) == (True, "paused")
        assert loop.ask(partial(loop.pause, True)) == (True, "already paused")
        before = stamps(bench)
        assert loop.ask(loop.step).success
        assert stamps(bench) == [*before, before[-1] + 2_000_000]
        assert loop.ask(partial(loop.step, 5)).success
        assert len(stamps(bench)) == len(before) + 6
        assert loop.ask(partial(loop.pause, False)) == (True, "running")
        assert loop.ask(partial(loop.pause, False)) == (True, "not paused: running")
        bench.until(lambda: len(bench.output.samples) > len(before) + 8)
    whole = stamps(bench)[:-1]  # the last one is where it was stopped
    spacing = set(np.diff(whole).tolist())
    assert spacing == {2_000_000}


def test_requests_are_served_while_a_deadline_is_far():
    with running(real_time_factor=1e-3) as (bench, loop):  # a tick takes 1 s, a sample 2 s
        bench.until(lambda: loop.counters.ticks == 1)
        assert loop.ask(partial(loop.pause, True), timeout=0.5) == (True, "paused")
        last = stamps(bench)[-1]
        assert last - stamps(bench)[0] == 1_000_000  # what was done since the last sample is one
        bench.until(lambda: bench.output.idles)
        assert bench.output.idles[0][2] == last
        assert loop.ask(partial(loop.pause, True)) == (True, "already paused")
        assert stamps(bench)[-2] < last == stamps(bench)[-1]  # and is published once
        assert loop.ask(loop.step).success
        assert stamps(bench)[-1] == last + 1_000_000


def test_an_answer_outlives_a_request_before_its_deadline():
    with running(sync="lockstep", real_time_factor=1e-3, lockstep_timeout=1.0) as (bench, loop):
        bench.begin()
        bench.stamped.append(answer(stamps(bench)[0]))
        bench.until(lambda: not bench.stamped)
        assert loop.ask(lambda: Reply(True, "served"), timeout=0.5) == (True, "served")
        bench.until(lambda: len(stamps(bench)) > 1)
        assert not loop.fault


def test_resume_makes_no_burst():
    with running(real_time_factor=1.0) as (bench, loop):
        bench.until(lambda: len(bench.output.samples) > 3)
        loop.ask(partial(loop.pause, True))
        time.sleep(0.2)
        before = loop.counters.ticks
        loop.ask(partial(loop.pause, False))
        assert loop.counters.ticks - before < 50
    assert bench.output.idles  # the state is shown meanwhile


def test_reset_goes_back_and_stamps_go_on():
    bench = Bench()
    start = bench.loop.simulation.state
    with bench.running() as loop:
        bench.until(lambda: len(bench.output.samples) > 5)
        loop.ask(partial(loop.pause, True))
        last = stamps(bench)[-1]
        assert loop.ask(loop.reset) == (True, "at the initial state, paused")
        assert loop.simulation.state == start
        bench.output.now = 0  # no time: cannot begin
        assert "no time yet" in loop.ask(loop.step).message
        bench.output.now = 1_000_000_000
        assert loop.ask(loop.step).success
        assert stamps(bench)[-2:] == [last + 2_000_000, last + 4_000_000]
        assert bench.output.samples[-2][1] == start


def test_a_fault_is_latched_until_a_reset():
    with running(scene="example2_heavy") as (bench, loop):
        loop.ask(partial(loop.pause, True))
        bench.queue.append(Box(data=(50.0, 0.0, 0.0)))
        loop.ask(partial(loop.pause, False))
        bench.until(lambda: loop.phase is Phase.FAULT)
        assert "gamma_1 > 1.570796 rad" in loop.fault
        assert bench.output.phases[-1].startswith("fault: stopped at t = ")
        bench.until(lambda: bench.output.idles and bench.output.idles[-1][1])
        held, _, _ = bench.output.idles[-1]
        assert held == bench.output.samples[-1][1]
        assert not loop.ask(partial(loop.pause, True)).success
        assert not loop.ask(loop.step).success
        assert not loop.ask(partial(loop.set_state, (0.7,) * 3, ZERO)).success
        assert loop.phase is Phase.FAULT
        assert loop.ask(loop.reset).success
        bench.until(lambda: loop.phase is Phase.RUNNING)
        assert loop.fault == ""
        bench.until(lambda: bench.output.acted[-1] == ZERO)  # the command is forgotten


def test_a_fault_among_ticks_done_at_once_is_told_at_its_tick():
    bench = Bench(scene="example2_heavy", publish_rate=10, wait_for_command=True)
    bench.queue.append(Box(data=(50.0, 0.0, 0.0)))
    with bench.running() as loop:
        bench.until(lambda: loop.phase is Phase.FAULT)
        ticks, last = loop.simulation.time_ns // 1_000_000, loop.simulation.state
    assert ticks % 100 and "gamma_1 > 1.570796 rad" in loop.fault
    assert bench.output.acted == [(50.0, 0.0, 0.0)] * ticks
    assert loop.counters.ticks == ticks
    assert stamps(bench)[-1] == stamps(bench)[0] + ticks * 1_000_000
    assert bench.output.samples[-1][1] == last


def test_set_state_is_checked():
    with running(wait_for_command=True) as (_, loop):
        given = (0.6, 0.7, 0.8), (0.1, 0.0, -0.1)
        assert loop.ask(partial(loop.set_state, *given)) == (True, "the state is set, waiting")
        assert loop.simulation.state.joints.gamma == pytest.approx(given[0], abs=1e-12)
        assert loop.simulation.state.joints.gamma_dot == pytest.approx(given[1], abs=1e-12)
        assert "stroke" in loop.ask(partial(loop.set_state, (9.0, 0.7, 0.8), ZERO)).message
        assert loop.simulation.state.joints.gamma == pytest.approx(given[0], abs=1e-12)
        assert loop.ask(loop.reset).success
        assert loop.simulation.state.joints.gamma != pytest.approx(given[0], abs=1e-3)


@pytest.mark.parametrize("error", [ZeroDivisionError("boom"), RunStopped("boom", 0.0, None)])
def test_whatever_a_step_raises_is_a_fault_and_the_thread_lives(error):
    class Broken(Simulation):
        broken = False

        def advance(self, *args):
            if self.broken:
                raise error
            super().advance(*args)

    with running(build=Broken) as (bench, loop):
        bench.until(lambda: len(bench.output.samples) > 2)
        loop.simulation.broken = True
        bench.until(lambda: loop.phase is Phase.FAULT)
        assert "boom" in loop.fault
        loop.simulation.broken = False
        assert loop.ask(loop.reset).success
        bench.until(lambda: loop.phase is Phase.RUNNING)


def test_lockstep_times_out_into_a_fault():
    with running(sync="lockstep", lockstep_timeout=0.05) as (bench, loop):
        bench.begin()
        bench.stamped.append(answer(stamps(bench)[0]))
        bench.until(lambda: loop.phase is Phase.FAULT)
        last = stamps(bench)[-1]
        assert f"no command answered the sample of {last} ns within 0.05 s" in loop.fault
        assert len(bench.output.acted) == 2


@pytest.mark.parametrize("factor", [0.0, 1.0])
def test_requests_do_not_put_off_the_timeout_in_lockstep(factor):
    with running(sync="lockstep", lockstep_timeout=0.5, real_time_factor=factor) as (bench, loop):
        bench.begin()
        began = time.monotonic()

        def asked():
            loop.post(lambda: Reply(True, ""))  # as the diagnostics do once a second
            time.sleep(0.05)
            return loop.phase is Phase.FAULT

        bench.until(asked, timeout=3.0)
        assert 0.4 < time.monotonic() - began < 1.5


def test_a_pause_does_not_count_as_waiting_for_an_answer():
    with running(sync="lockstep", lockstep_timeout=0.3) as (bench, loop):
        bench.begin()
        loop.ask(partial(loop.pause, True))
        time.sleep(0.4)
        loop.ask(partial(loop.pause, False))
        bench.stamped.append(answer(stamps(bench)[0]))
        bench.until(lambda: len(bench.output.samples) > 1)


def test_a_step_in_lockstep_without_a_controller_does_not_hold_other_requests():
    """Its wait has a bound of its own, and an answer that comes later is used by the next step."""
    with running(sync="lockstep", lockstep_timeout=10.0) as (bench, loop):
        assert loop.ask(partial(loop.pause, True)).success
        began = time.monotonic()
        waiting = threading.Thread(target=loop.ask, args=(loop.step,))
        waiting.start()
        assert loop.ask(partial(loop.pause, True)) == (True, "already paused")
        waiting.join()
        reply = loop.ask(loop.step)
        assert time.monotonic() - began < 2.0
        assert not reply.success and "no controller answers: no command answered" in reply.message
        assert loop.phase is Phase.PAUSED and not loop.fault
        bench.stamped.append(answer(stamps(bench)[-1]))
        assert loop.ask(loop.step).success
        assert len(stamps(bench)) == 2


def test_a_step_that_does_not_end_is_a_fault_and_everything_is_answered():
    class Stuck(Simulation):
        stuck = threading.Event()
        released = threading.Event()

        def advance(self, *args):
            while self.stuck.is_set() and not self.released.is_set():
                pass
            super().advance(*args)

    with running(build=Stuck) as (bench, loop):
        bench.until(lambda: len(bench.output.samples) > 2)
        bench.loop.simulation.stuck.set()
        began = time.process_time()  # its own: on a busy machine 0.4 s of it take any time

        def watched():
            loop.watch()
            time.sleep(0.02)
            return loop.phase is Phase.FAULT

        bench.until(watched)
        assert bench.output.phases[-1].startswith("fault: a step has not ended after")
        asked = time.process_time()
        assert loop.ask(loop.reset) == (False, f"not done: {loop.fault}")
        assert time.process_time() - asked < 0.5
        assert 0.4 < asked - began < 1.0
        loop.simulation.released.set()
        bench.until(lambda: bench.output.idles and bench.output.idles[-1][1])
        assert loop.ask(loop.reset).success  # what could not be done has been forgotten
        bench.until(lambda: loop.phase is Phase.RUNNING)


def test_a_fault_ends_a_run_with_a_duration():
    bench = Bench(scene="example2_heavy", duration=10.0, wait_for_command=True)
    bench.queue.append(Box(data=(50.0, 0.0, 0.0)))
    bench.loop.run()
    assert bench.loop.phase is Phase.FAULT and bench.loop.failed
    assert "gamma_1 > 1.570796 rad" in bench.loop.fault


def test_it_waits_for_subscribers_and_no_longer_than_allowed():
    bench = Bench(duration=0.01, wait_for_subscribers=("joint_states",))
    bench.output.missing = ["/joint_states"]
    with bench.running() as loop:
        bench.until(lambda: len(bench.output.idles) > 2)
        assert loop.phase is Phase.WAITING
        bench.output.missing = []
        bench.until(lambda: loop.phase is Phase.FINISHED)
    bench = Bench(wait_for_subscribers=("joint_states",), subscriber_timeout=0.2)
    bench.output.missing = ["/joint_states"]
    bench.loop.run()
    assert bench.loop.failed
    assert "no subscriber of /joint_states within 0.2 s" in bench.loop.fault


def test_states_that_are_no_samples_have_the_time_at_which_they_hold():
    bench = Bench(wait_for_command=True, real_time_factor=1.0)

    def idle_stamps():
        return [stamp for _, _, stamp in bench.output.idles]

    with bench.running() as loop:
        bench.until(lambda: len(idle_stamps()) > 1)
        bench.output.now += 5
        bench.until(lambda: idle_stamps()[-1] == bench.output.now)
        bench.queue.append(Box(data=(0.0, 0.0, 0.0)))
        bench.until(lambda: len(bench.output.samples) > 3)
        assert stamps(bench)[0] > max(idle_stamps())
        loop.ask(partial(loop.pause, True))
        shown = len(idle_stamps())
        bench.until(lambda: len(idle_stamps()) > shown)
        assert idle_stamps()[-1] == stamps(bench)[-1]  # samples will follow it
        loop.ask(loop.reset)
        bench.output.now += 10**9
        bench.until(lambda: idle_stamps()[-1] == bench.output.now)
    assert idle_stamps() == sorted(idle_stamps())


@pytest.mark.parametrize(("of_the_run_before", "starts"), [(True, False), (False, True)])
def test_after_a_reset_a_late_answer_does_not_start_the_run(of_the_run_before, starts):
    with running(sync="lockstep") as (bench, loop):
        bench.begin()
        loop.ask(loop.reset)
        shown = bench.output.idles[-1][2]
        bench.stamped.append(answer(stamps(bench)[-1] if of_the_run_before else shown))
        bench.until(lambda: not bench.stamped)
        time.sleep(0.05)
        assert (len(stamps(bench)) > 1) == starts


def test_requests_after_the_end_are_refused():
    bench = Bench(duration=0.002)
    bench.loop.run()
    assert not bench.loop.ask(bench.loop.reset).success


@pytest.mark.parametrize(("waits", "phase"), [(False, Phase.RUNNING), (True, Phase.WAITING)])
def test_to_resume_a_reset_run_answers_with_the_phase_it_then_has(waits, phase):
    with running(wait_for_command=waits) as (_, loop):
        for request in (partial(loop.pause, True), loop.reset):
            assert loop.ask(request).success
        assert loop.ask(partial(loop.pause, False)) == Reply(True, phase.value)
        assert loop.phase is phase


def test_words_and_values_of_the_diagnostics_do_not_contradict_each_other():
    """The run goes on while they are read: what is not in the values is told the next time."""
    bench = Bench(wait_for_command=True)
    pacer = Pacer(1_000_000, 0.0, SteadyTime())
    diagnostics = RunDiagnostics(bench.loop, bench.input, pacer, 1e-3)
    before = diagnostics.values(1)
    bench.loop.phase, bench.input.timeouts, bench.input.begun = Phase.RUNNING, 1, True
    assert diagnostics.status(before, []) == (OK, "waiting", [])
    level, text, news = diagnostics.status(diagnostics.values(1), [])
    assert level == WARN and text.startswith("running; no command within command_timeout")
    assert len(news) == 1


def test_simulation_interfaces_are_the_same_machine():
    """The handlers with plain objects for messages: the package is in no wheel."""
    bench, left = Bench(), threading.Event()
    with bench.running() as loop:
        answers = SimulationInterfaces(loop, left.set)

        def call(service, **given):
            response = Box(result=Box(result=None, error_message=""), state=Box(state=None))
            return getattr(answers, service)(Box(**given), response)

        def state():
            return call("get_simulation_state").state.state

        def to(number):
            return call("set_simulation_state", state=Box(state=number)).result.result

        def reset(scope):
            return call("reset_simulation", scope=scope).result.result

        bench.until(lambda: loop.phase is Phase.RUNNING)
        assert (state(), call("step_simulation", steps=1).result.result) == (1, 4)
        assert (to(2), to(2)) == (1, 101)
        before = len(bench.output.samples)
        assert call("step_simulation", steps=3).result.result == 1
        assert len(bench.output.samples) == before + 3
        assert (reset(1), reset(255), state()) == (0, 1, 0)
        assert (to(2), to(1), to(0), state(), to(4)) == (103, 1, 1, 0, 0)
        assert (reset(3), reset(6)) == (0, 1)
        assert not left.is_set()
        assert to(3) == 1 and left.is_set()
