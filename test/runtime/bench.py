# SPDX-License-Identifier: Apache-2.0
"""A run without ROS: messages as plain objects, topics on which they arrive, and its
output.
"""

import math
import threading
import time
from functools import partial
from types import SimpleNamespace as Message

from sst_ros import load_scene
from sst_ros.runtime.run_loop import RunLoop
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.tick_loop import Pacer, RunParts, SteadyTime
from sst_ros.runtime.torque_input import MOST_WAITING, TorqueInput
from sst_ros.scene.loads import ACTUATED_JOINTS
from sst_ros.simulation.simulation import Simulation


def duration(nanoseconds):
    sec, nanosec = divmod(round(nanoseconds), 10**9)
    return Message(sec=sec, nanosec=nanosec)


def plain(torque):
    return Message(data=torque)


def stamped(stamp_ns, effort=(0.0, 0.0, 0.0), names=ACTUATED_JOINTS):
    header = Message(stamp=duration(stamp_ns))
    return Message(header=header, name=list(names), effort=list(effort))


class Arrived(list):
    """Messages that came long ago, at `arrived_ns`, or after some requests for them."""

    arrived_ns = -math.inf
    after_requests = 0

    def __init__(self, messages=()):
        super().__init__(messages)
        self.asked = []

    @property
    def waiting(self):
        return len(self) > 0 and (
            self.arrived_ns > 0 or len(self.asked) <= self.after_requests
        )

    def read(self, until_ns):
        self.asked.append(until_ns)
        if self.arrived_ns > until_ns or len(self.asked) <= self.after_requests:
            return ()
        found = self[:MOST_WAITING]
        del self[:MOST_WAITING]
        return found


class Output:
    """Keeps what the run publishes.

    Gives time from 1 s on, by its own clock if it has one.
    """

    unread = False

    def __init__(self, missing, own_clock):
        self.own_clock = own_clock
        self.samples, self.acted, self.idles, self.phases = [], [], [], []
        self.flushed, self.unpublished = 0, {}
        self.now, self.missing = 10**9, missing
        self.on_sample = lambda stamp_ns: None

    def now_ns(self):
        return self.now

    def missing_subscribers(self):
        return self.missing

    def ticks(self, torque, moment, count):
        self.acted.extend([torque] * count)

    def sample(self, simulation, stamp_ns):
        self.now = stamp_ns if self.own_clock else self.now
        self.samples.append((stamp_ns, simulation.state))
        self.on_sample(stamp_ns)

    def flush(self):
        self.flushed = len(self.acted)

    def idle(self, state, stamp_ns, *, at_rest, moves=False):
        self.now = stamp_ns if moves else self.now
        self.idles.append((state, at_rest, stamp_ns))

    def publish_phase(self, phase):
        self.unpublished[phase.partition(":")[0]] = len(self.acted) - self.flushed
        self.phases.append(phase)

    @property
    def stamps(self):
        return [stamp for stamp, _ in self.samples]


class HandClock:
    """A clock that only the test moves on: no deadline comes while it looks."""

    runs = False

    def __init__(self):
        self.now = 10**9

    def now_ns(self):
        return self.now

    def sleep(self, _):
        time.sleep(0.001)
        self.now += 100_000 * self.runs


class Bench:
    """A run; a busy machine may take long for what is quick, so no command is let go
    of.
    """

    def __init__(
        self, scene="swing", build=Simulation, clock=None, commands=(), **given
    ):
        speed = 0.0 if clock is None else 1.0
        given = {"real_time_factor": speed, "command_timeout": 0.0, **given}
        parameters = SimulatorParameters(scene=scene, **given)
        run = parameters.run
        self.queue, self.stamped = Arrived(map(plain, commands)), Arrived()
        self.output = Output(
            [*parameters.wait_for_subscribers], parameters.publish_clock
        )
        self.input = TorqueInput(run, None, self.queue, self.stamped)
        self.pacer = Pacer(
            run.period_ns, parameters.real_time_factor, clock or SteadyTime()
        )
        parts = RunParts(run, self.input, self.pacer, self.output)
        self.loop = RunLoop(load_scene(scene), build, parts)
        self.thread = threading.Thread(target=self.loop.run, daemon=True)

    def ask(self, name, *given):
        return self.loop.ask(partial(getattr(self.loop, name), *given))

    def begin(self):
        """Answer the state that is shown before a run in lockstep."""
        self.stamped.append(stamped(0))
        self.until(lambda: self.output.samples)

    def until(self, condition, timeout=100.0):
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.001)

    def to(self, phase):
        """Wait until the phase is published."""
        self.until(
            lambda: (
                self.output.phases and self.output.phases[-1].startswith(phase.value)
            )
        )

    def end(self):
        self.loop.stop()
        self.thread.join(40)
        assert not self.thread.is_alive()


def run_here(*args, **given):
    """A run that ends by itself."""
    bench = Bench(*args, **given)
    bench.loop.run()
    return bench
