# SPDX-License-Identifier: Apache-2.0
"""The state machine of a run, in a thread of its own, without ROS."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from runtime.bench import Bench, HandClock, plain, run_here, stamped
from slow_cases import slow_after

from sst_ros.errors import RunStopped
from sst_ros.integration import method_steps
from sst_ros.runtime import run_loop, tick_loop
from sst_ros.runtime.diagnostics import OK, WARN, RunDiagnostics
from sst_ros.runtime.run_loop import Phase, Reply
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import ZERO

HEAVY = "example2_heavy"
HIT = (50.0, 0.0, 0.0)
"""Torques that lead `HEAVY` to the end of its stroke [N m]."""


@pytest.fixture
def start():
    """Start runs in threads, which have ended when the test has."""
    started = []

    def begin(*args, **given):
        started.append(Bench(*args, **given))
        started[-1].thread.start()
        return started[-1]

    yield begin
    for bench in started:
        bench.end()


@pytest.fixture
def at_once(monkeypatch):
    """As many ticks are done together as on a machine on which none takes long."""
    monkeypatch.setattr(tick_loop, "_AT_ONCE_S", 1e6)


def test_a_run_ends_after_its_duration_with_every_sample():
    bench = run_here(duration=0.0105, publish_rate=250)
    output = bench.output
    assert bench.loop.phase is Phase.FINISHED
    assert output.stamps == [output.stamps[0] + k * 1_000_000 for k in (0, 4, 8, 11)]
    assert len(output.acted) == bench.loop.counters.ticks == 11
    assert output.phases == ["waiting", "running", "finished"]
    assert output.unpublished["finished"] == 0 < output.flushed == 11
    assert not bench.ask("reset").success  # the thread has ended


def test_no_torque_is_unpublished_when_a_run_does_not_go_on(start):
    bench = start(HEAVY)
    output = bench.output
    bench.until(lambda: output.acted)
    bench.ask("pause", True)
    assert output.unpublished["paused"] == 0 < output.flushed
    bench.queue.append(plain(HIT))
    bench.ask("pause", False)
    bench.to(Phase.FAULT)
    assert output.unpublished["fault"] == 0

    bench = start()
    bench.until(lambda: bench.output.acted)
    bench.ask("pause", True)
    assert bench.ask("step").success
    bench.end()
    assert bench.output.flushed == len(bench.output.acted)  # it ends right after a step


def test_a_run_stepped_to_its_end_is_finished_without_fault(start):
    bench = start(duration=0.02, clock=HandClock())
    bench.to(Phase.RUNNING)
    bench.ask("pause", True)
    assert bench.ask("step", 20).success
    bench.to(Phase.FINISHED)
    assert bench.output.phases[-2:] == ["paused", "finished"]
    assert bench.output.unpublished["finished"] == 0


def test_ticks_are_done_together_and_commands_keep_their_tick(at_once):
    """The command comes between the beginnings of two ticks that are done together."""
    torque = (1.0, 2.0, 3.0)
    given = {"real_time_factor": 1.0, "duration": 0.02, "publish_rate": 500}
    bench = Bench(commands=[torque], **given)
    bench.queue.after_requests = 3
    bench.loop.run()
    assert bench.output.acted == 3 * [ZERO] + 17 * [torque]
    # the first two are done alone, to measure them
    first, second = bench.queue.asked[2:4]
    assert second - first == 1_000_000


def test_a_free_run_passes_over_samples_that_nothing_receives(at_once):
    bench = Bench(duration=0.2, publish_rate=500)
    bench.output.unread = True
    bench.loop.run()
    stamps = bench.output.stamps
    assert (stamps[-1] - stamps[0], bench.loop.counters.ticks) == (200_000_000, 200)
    assert len(stamps) < bench.loop.counters.published == 101
    simulation = Simulation("swing")
    simulation.steps(ZERO, 1_000_000, 200)
    assert bench.output.samples[-1][1] == simulation.state


def test_a_change_of_method_loads_no_code_inside_a_tick(monkeypatch):
    begun, compile_functions = [], method_steps.compile_functions

    def compiling(*arguments):
        begun.append(bench.loop.begun)
        return compile_functions(*arguments)

    method_steps.steps_of.cache_clear()
    bench = Bench(scene="stiff", duration=0.1)
    monkeypatch.setattr(method_steps, "compile_functions", compiling)
    bench.loop.run()
    assert bench.loop.phase is Phase.FINISHED and bench.loop.simulation.changes
    assert begun and not any(begun)


def test_pause_is_idempotent_and_a_step_is_one_sample(start, at_once):
    bench = start()
    output = bench.output
    bench.until(lambda: len(output.samples) > 3)
    refused = "refused: only a paused run can be stepped, it is running"
    assert bench.ask("step") == (False, refused)
    assert bench.ask("pause", True) == (True, "paused")
    assert bench.ask("pause", True) == (True, "already paused")
    before = output.stamps
    assert bench.ask("step").success
    assert output.stamps == [*before, before[-1] + 2_000_000]
    assert bench.ask("step", 5).success
    assert len(output.stamps) == len(before) + 6
    assert bench.ask("pause", False) == (True, "running")
    assert bench.ask("pause", False) == (True, "not paused: running")
    bench.until(lambda: len(output.samples) > len(before) + 8)
    bench.end()
    # The last one is where it was stopped.
    assert set(np.diff(output.stamps[:-1]).tolist()) == {2_000_000}


def test_requests_are_served_while_a_deadline_is_far(start):
    clock = HandClock()
    bench = start(clock=clock)
    output = bench.output
    bench.to(Phase.RUNNING)
    clock.now += 1_000_000
    bench.until(lambda: output.acted)  # the first of the two ticks of a sample
    assert bench.ask("pause", True) == (True, "paused")
    last = output.stamps[-1]
    # what was done since the last sample is one
    assert last - output.stamps[0] == 1_000_000
    bench.until(lambda: output.idles)
    assert last < output.idles[-1][2] < last + 100
    assert bench.ask("pause", True) == (True, "already paused")
    assert output.stamps[-2] < last == output.stamps[-1]  # and is published once
    assert bench.ask("step").success
    assert output.stamps[-1] == last + 1_000_000


def test_an_answer_outlives_a_request_before_its_deadline(start):
    clock = HandClock()
    bench = start(sync="lockstep", clock=clock)
    bench.begin()
    bench.stamped.append(stamped(bench.output.stamps[0]))
    bench.until(lambda: not bench.stamped)
    assert bench.loop.ask(lambda: Reply(True, "served")) == (True, "served")
    assert len(bench.output.samples) == 1
    clock.runs = True
    bench.until(lambda: len(bench.output.samples) > 1)
    assert not bench.loop.fault


def test_resume_makes_no_burst(start):
    clock = HandClock()
    bench = start(clock=clock)
    bench.to(Phase.RUNNING)
    bench.ask("pause", True)
    bench.until(lambda: bench.output.idles)  # the state is shown meanwhile
    clock.now += 200_000_000
    bench.ask("pause", False)
    assert bench.ask("pause", True).success
    assert bench.loop.counters.ticks == bench.pacer.missed == 0


def test_reset_goes_back_and_stamps_go_on(start):
    bench = start()
    output = bench.output
    bench.until(lambda: len(output.samples) > 5)
    bench.ask("pause", True)
    last = output.stamps[-1]
    assert bench.ask("reset") == (True, "at the initial state, paused")
    initial = Simulation("swing").state
    assert bench.loop.simulation.state == initial
    output.now = 0  # no time: cannot begin
    assert "no time yet" in bench.ask("step").message
    output.now = 10**9
    assert bench.ask("step").success
    assert output.stamps[-2:] == [last + 2_000_000, last + 4_000_000]
    assert output.samples[-2][1] == initial


def test_a_fault_is_latched_until_a_reset(start):
    bench = start(HEAVY)
    output, loop = bench.output, bench.loop
    bench.queue.append(plain(HIT))
    bench.to(Phase.FAULT)
    assert "gamma_1 > 1.570796 rad" in loop.fault
    assert output.phases[-1].startswith("fault: stopped at t = ")
    bench.until(lambda: output.idles and output.idles[-1][1])
    assert output.idles[-1][0] == output.samples[-1][1]
    for request in (("pause", True), ("step",), ("set_state", (0.7,) * 3, ZERO)):
        assert not bench.ask(*request).success
    assert loop.phase is Phase.FAULT
    assert bench.ask("reset").success
    bench.to(Phase.RUNNING)
    assert loop.fault == ""
    bench.until(lambda: output.acted[-1] == ZERO)  # the command is forgotten


@pytest.mark.parametrize("fails", [False, True])
def test_a_run_does_not_begin_between_a_reset_and_a_stop(start, fails):
    bench = start(HEAVY)
    bench.until(lambda: bench.output.samples)
    if fails:
        bench.queue.append(plain(HIT))
        bench.to(Phase.FAULT)
    assert bench.ask("halt") == Reply(True, "at the initial state, paused")
    loop, samples = bench.loop, len(bench.output.samples)
    assert loop.phase is Phase.PAUSED and not loop.begun and not loop.fault
    assert loop.simulation.time_ns == 0
    assert bench.ask("halt").success and len(bench.output.samples) == samples


def test_a_fault_among_ticks_done_at_once_ends_a_run():
    given = {"publish_rate": 10, "wait_for_command": True, "duration": 10.0}
    bench = run_here(HEAVY, commands=[HIT], **given)
    loop, output = bench.loop, bench.output
    assert loop.phase is Phase.FAULT and loop.failed
    ticks = loop.simulation.time_ns // 1_000_000
    assert ticks % 100 and "gamma_1 > 1.570796 rad" in loop.fault
    assert output.acted == [HIT] * ticks
    assert loop.counters.ticks == ticks
    assert output.stamps[-1] == output.stamps[0] + ticks * 1_000_000
    assert output.samples[-1][1] == loop.simulation.state


def test_set_state_is_checked(start):
    bench = start("example1", wait_for_command=True)
    given = (0.6, 0.7, 0.8), (0.1, 0.0, -0.1)
    assert bench.ask("set_state", *given) == (True, "the state is set, waiting")
    joints = bench.loop.simulation.state.joints
    assert joints.gamma == pytest.approx(given[0], abs=1e-12)
    assert joints.gamma_dot == pytest.approx(given[1], abs=1e-12)
    assert "stroke" in bench.ask("set_state", (3.0, 0.7, 0.8), ZERO).message
    assert bench.loop.simulation.state.joints == joints
    assert bench.ask("reset").success
    assert bench.loop.simulation.state.joints.gamma != pytest.approx(given[0], abs=1e-3)


@pytest.mark.parametrize(
    "error", [ZeroDivisionError("boom"), RunStopped("boom", 0.0, None)]
)
def test_whatever_a_step_raises_is_a_fault_and_the_thread_lives(start, error):
    class Broken(Simulation):
        broken = False

        def advance(self, *args):
            if self.broken:
                raise error
            super().advance(*args)

    bench = start(build=Broken)
    bench.until(lambda: len(bench.output.samples) > 2)
    bench.loop.simulation.broken = True
    bench.to(Phase.FAULT)
    assert "boom" in bench.loop.fault
    bench.loop.simulation.broken = False
    assert bench.ask("reset").success
    bench.to(Phase.RUNNING)


@pytest.mark.parametrize("factor", slow_after(1, [0.0, 1.0]))
def test_requests_do_not_put_off_the_fault_of_a_lockstep_timeout(start, factor):
    began = time.monotonic()
    bench = start(sync="lockstep", lockstep_timeout=0.5, real_time_factor=factor)
    output = bench.output
    output.on_sample = lambda stamp: bench.stamped.extend(
        [stamped(stamp)] * (not output.acted)
    )
    bench.begin()

    def asked():
        bench.loop.post(lambda: Reply(True, ""))  # as the diagnostics do once a second
        time.sleep(0.05)
        return bench.loop.phase is Phase.FAULT

    bench.until(asked)
    text = f"no command answered the sample of {output.stamps[-1]} ns within 0.5 s"
    assert text in bench.loop.fault and time.monotonic() - began > 0.5
    assert len(output.acted) == 2


def test_a_pause_does_not_count_as_waiting_for_an_answer(start):
    bench = start(sync="lockstep", lockstep_timeout=0.3)
    bench.output.on_sample = lambda _: bench.loop.post(partial(bench.loop.pause, True))
    bench.begin()
    bench.to(Phase.PAUSED)
    time.sleep(0.4)
    bench.until(lambda: bench.output.idles)
    # to the sample, shown again
    bench.stamped.append(stamped(bench.output.idles[-1][2]))
    bench.ask("pause", False)
    bench.until(lambda: len(bench.output.samples) > 1)


def test_a_step_without_a_controller_holds_no_other_request(start):
    """Its wait has a bound of its own, and an answer that comes later is used by the
    next step.
    """
    bench = start(sync="lockstep", lockstep_timeout=100.0)
    assert bench.ask("pause", True).success
    began = time.monotonic()
    waiting = threading.Thread(target=bench.ask, args=("step",))
    waiting.start()
    assert bench.ask("pause", True) == (True, "already paused")
    waiting.join()
    reply = bench.ask("step")
    assert time.monotonic() - began < 50.0
    assert (
        not reply.success
        and "no controller answers: no command answered" in reply.message
    )
    assert bench.loop.phase is Phase.PAUSED and not bench.loop.fault
    bench.stamped.append(stamped(bench.output.stamps[-1]))
    assert bench.ask("step").success
    assert len(bench.output.stamps) == 2


def test_requests_of_four_callers_at_once_are_all_answered(start):
    bench = start("example1", clock=HandClock())
    calls = [("pause", True), ("pause", False), ("step",), ("reset",)] * 25
    with ThreadPoolExecutor(4) as pool:
        replies = [*pool.map(lambda call: bench.ask(*call), calls)]
    refused = [reply.message for reply in replies if not reply.success]
    assert all("only a paused run can be stepped" in words for words in refused)
    assert bench.ask("reset").success and not bench.loop.fault


def test_it_waits_for_subscribers_and_no_longer_than_allowed(start):
    bench = start(duration=0.01, wait_for_subscribers=("joint_states",))
    bench.until(lambda: len(bench.output.idles) > 2)
    assert bench.loop.phase is Phase.WAITING
    bench.output.missing = []
    bench.to(Phase.FINISHED)
    loop = run_here(wait_for_subscribers=("joint_states",), subscriber_timeout=0.2).loop
    assert loop.failed
    assert "no subscriber of joint_states within 0.2 s" in loop.fault


def test_states_that_are_no_samples_have_the_time_when_they_hold(start):
    bench = start(wait_for_command=True, real_time_factor=1.0)
    output = bench.output

    def idle_stamps():
        return [stamp for _, _, stamp in output.idles]

    bench.until(lambda: len(idle_stamps()) > 1)
    output.now += 10**6
    bench.until(lambda: idle_stamps()[-1] == output.now)
    bench.queue.append(plain(ZERO))
    bench.until(lambda: len(output.samples) > 3)
    assert output.stamps[0] > max(idle_stamps())
    bench.ask("pause", True)
    shown, last = len(idle_stamps()), output.stamps[-1]
    bench.until(lambda: len(idle_stamps()) > shown + 1)
    passed = np.subtract(idle_stamps()[shown:], last)
    # none twice, and samples will follow
    assert passed[0] > 0 and set(np.diff(passed)) == {1}
    assert bench.ask("step").success and output.stamps[-1] >= last + 1_000_000
    bench.ask("reset")
    output.now += 10**9
    bench.until(lambda: idle_stamps()[-1] == output.now)
    assert idle_stamps() == sorted(idle_stamps())


def test_the_state_is_shown_while_the_code_is_loaded(start):
    """On a busy machine that took 20 s, and a controller gave up after 10 s without a
    state.
    """
    loaded = threading.Event()

    class Slow(Simulation):
        def load_code(self):
            assert loaded.wait(40.0)
            super().load_code()

    bench = start(build=Slow, duration=0.01)
    output = bench.output
    bench.until(lambda: len(output.idles) > 3)
    assert not output.samples and output.phases == ["waiting"]
    loaded.set()
    bench.to(Phase.FINISHED)
    assert output.stamps[0] > output.idles[-1][2]


def test_a_request_waits_until_the_code_is_loaded(start, monkeypatch):
    """However long that takes on a busy machine."""
    monkeypatch.setattr(run_loop, "_LONGEST_REPLY_S", 0.05)
    loaded = threading.Event()

    class Slow(Simulation):
        def load_code(self):
            assert loaded.wait(40.0)

    bench = start(build=Slow)
    idles = bench.output.idles
    bench.until(lambda: idles)
    with ThreadPoolExecutor() as pool:
        reply = pool.submit(bench.ask, "pause", True)
        shown = len(idles)
        bench.until(lambda: len(idles) > shown + 3 or reply.done())
        replied_before = reply.done()
        monkeypatch.setattr(run_loop, "_LONGEST_REPLY_S", 40.0)
        loaded.set()
        assert reply.result(40.0) == (True, "paused")
    assert not replied_before


def test_a_request_that_is_not_served_in_time_says_so(start, monkeypatch):
    monkeypatch.setattr(run_loop, "_LONGEST_REPLY_S", 0.05)
    bench = start()
    bench.to(Phase.RUNNING)
    goes_on = threading.Event()
    bench.loop.post(lambda: Reply(goes_on.wait(40.0), ""))
    reply = bench.ask("pause", True)
    goes_on.set()
    assert reply == (False, "not done: the run did not reply within 0.05 s")


def test_a_run_is_stopped_while_its_code_is_loaded(start):
    class Hanging(Simulation):
        def load_code(self):
            threading.Event().wait(40.0)

    bench = start(build=Hanging)
    bench.until(lambda: bench.output.idles)
    bench.end()


def test_code_that_cannot_be_loaded_is_a_fault(start):
    class Broken(Simulation):
        def load_code(self):
            raise OSError("no such code")

    bench = start(build=Broken)
    bench.to(Phase.FAULT)
    assert "internal error: OSError: no such code" in bench.loop.fault


@pytest.mark.parametrize("sync", slow_after(1, ["free", "lockstep"]))
@pytest.mark.parametrize("publish_clock", slow_after(1, [True, False]))
def test_no_two_states_have_one_stamp_if_the_clock_stands_still(
    start, publish_clock, sync
):
    """Before the run, in a pause, in a fault and after a reset."""
    bench = start(
        "swing", wait_for_command=True, sync=sync, publish_clock=publish_clock
    )
    output = bench.output

    def show_more():
        shown = len(output.idles)
        bench.until(lambda: len(output.idles) > shown + 2)

    show_more()
    if sync == "free":
        bench.queue.append(plain(ZERO))
        bench.until(lambda: len(output.samples) > 2)
    assert bench.ask("pause", True).success
    show_more()
    bench.loop.post(lambda: bench.loop._fail("as a test wants it"))
    bench.to(Phase.FAULT)
    show_more()
    assert bench.ask("reset").success
    show_more()
    stamps = [stamp for _, _, stamp in output.idles]
    assert min(np.diff(stamps)) > 0
    assert not set(stamps) & set(output.stamps)


@pytest.mark.parametrize(
    ("of_the_run_before", "starts"), [(True, False), (False, True)]
)
def test_after_a_reset_a_late_answer_does_not_start_the_run(
    start, of_the_run_before, starts
):
    bench = start(sync="lockstep")
    bench.begin()
    bench.ask("reset")
    shown = bench.output.idles[-1][2]
    bench.stamped.append(
        stamped(bench.output.stamps[-1] if of_the_run_before else shown)
    )
    bench.until(lambda: not bench.stamped)
    if starts:
        bench.until(lambda: len(bench.output.samples) > 1)
    time.sleep(0.05)
    assert (len(bench.output.samples) > 1) == starts


def test_before_the_run_our_clock_goes_on_by_whole_periods(start):
    """So that a controller manager, which is updated by it, can have its controllers
    activated.
    """
    bench = start(sync="lockstep", publish_clock=True)
    output, period_ns = bench.output, 2_000_000

    def idles():
        return [stamp for _, _, stamp in output.idles]

    bench.until(lambda: len(idles()) > 3)
    # the first is that of the start
    assert np.diff(idles())[1:3].tolist() == [period_ns] * 2
    bench.stamped.append(stamped(idles()[-2]))  # late: an update has been since
    bench.until(lambda: not bench.stamped)
    assert not output.samples
    while not output.samples:
        if not bench.stamped:
            bench.stamped.append(stamped(idles()[-1]))
        time.sleep(0.001)
    assert output.stamps == [idles()[-1] + period_ns]
    for stamp in (1, 2, 3):
        bench.stamped.append(stamped(output.stamps[-1]))
        bench.until(lambda count=stamp + 1: len(output.samples) == count)
    assert np.diff(output.stamps).tolist() == [period_ns] * 3
    # A run that was reset in a pause begins with the next period when it is resumed.
    assert bench.ask("pause", True).success and bench.ask("reset").success
    assert bench.ask("pause", False) == (True, "running")
    bench.until(lambda: len(output.samples) == 5)
    assert output.stamps[4] == output.stamps[3] + period_ns


@pytest.mark.parametrize(
    ("waits", "phase"), [(False, Phase.RUNNING), (True, Phase.WAITING)]
)
def test_resuming_a_reset_run_answers_with_its_new_phase(start, waits, phase):
    bench = start(wait_for_command=waits)
    assert bench.ask("pause", True).success and bench.ask("reset").success
    assert bench.ask("pause", False) == (True, phase.value)
    assert bench.loop.phase is phase


def test_words_and_values_of_the_diagnostics_agree():
    """The run goes on while they are read: what is not in the values is told the next
    time.
    """
    bench = Bench(wait_for_command=True)
    diagnostics = RunDiagnostics(bench.loop)
    before = diagnostics.values(1)
    bench.loop.phase = Phase.RUNNING
    unheard = diagnostics.status(diagnostics.values(1), [])
    assert unheard == (OK, "running, no command yet: zero torque", [])
    bench.loop.phase, bench.input.timeouts, bench.input.begun = Phase.RUNNING, 1, True
    assert diagnostics.status(before, []) == (OK, "waiting", [])
    level, text, news = diagnostics.status(diagnostics.values(1), [])
    assert level == WARN and text.startswith(
        "running; no command within command_timeout"
    )
    assert len(news) == 1
