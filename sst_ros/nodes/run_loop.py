# SPDX-License-Identifier: Apache-2.0
"""The run: waiting, running, paused, fault, finished. One thread owns it; no ROS types in here.

Others ask for changes by `ask`. They happen between two samples, in the run's own thread.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable

from sst_ros.errors import RunStopped, SstError
from sst_ros.nodes.commands import CommandBoard, Settings
from sst_ros.nodes.counters import Counters
from sst_ros.nodes.pacing import Pacer
from sst_ros.nodes.run_parts import Answer, Audience, Phase, Reply
from sst_ros.scene import Initial, Scene
from sst_ros.simulation import Simulation, Triple

IDLE_PERIOD_S = 0.1
_POLL_S = 0.001
_ANSWER_S = 30.0


class RunLoop:
    """State machine of one node's run.

    Attributes:
        phase: what it does now.
        fault: why it does nothing any more, until a reset.
        begun: its first sample has been published since the start or the last reset.
        simulation: the present one; its `state` may be read by any thread.
        counters: counters.

    """

    def __init__(
        self,
        scene: Scene,
        build: Callable[[Scene], Simulation],
        settings: Settings,
        board: CommandBoard,
        pacer: Pacer,
        audience: Audience,
    ) -> None:
        self.phase, self.fault, self.begun = Phase.WAITING, "", False
        self.counters = Counters()
        self.simulation = self._original = build(scene)
        self._build, self._settings, self._board = build, settings, board
        self._pacer, self._audience = pacer, audience
        self._period_ns = settings.parameters.period_ns
        self._ticks_per_sample = settings.parameters.ticks_per_sample
        duration = settings.parameters.duration * settings.parameters.rate
        self._last_tick = math.ceil(duration - 1e-6) or math.inf
        self._tick = self._start_ns = self._stamp_ns = 0
        self._requests: deque[tuple[Callable[[], Reply], Answer]] = deque()
        self._asked, self._stop = threading.Event(), threading.Event()

    def ask(self, request: Callable[[], Reply], timeout: float = _ANSWER_S) -> Reply:
        """Have a request (`pause`, `reset`, ...) served by the run's thread; wait for the reply."""
        answer = self.post(request)
        if self._stop.is_set() or not answer.done.wait(timeout):
            return Reply(False, "the run did not answer: the node is shutting down or too slow")
        return answer.reply

    def post(self, request: Callable[[], Reply]) -> Answer:
        """Have a request served; do not wait."""
        answer = Answer()
        self._requests.append((request, answer))
        self._asked.set()
        return answer

    def stop(self) -> None:
        """Have `run` return soon."""
        self._stop.set()
        self._asked.set()

    def run(self) -> None:
        """Live until `stop` or the end of the run."""
        self._tell()
        act = {
            Phase.WAITING: self._wait_for_start,
            Phase.RUNNING: self._to_the_next_sample,
            Phase.PAUSED: self._idle,
            Phase.FAULT: self._idle,
        }
        while not self._stop.is_set() and self.phase is not Phase.FINISHED:
            try:
                self._serve()
                act[self.phase]()
            except RunStopped as stopped:
                self._fail(str(stopped))
            except Exception as error:
                at = traceback.extract_tb(error.__traceback__)[-1]
                where = f"{at.filename.rpartition('/')[2]}:{at.lineno}"
                self._fail(f"internal error: {type(error).__name__}: {error} ({where})")
                self._stop.wait(IDLE_PERIOD_S)
        self._end_of_run()

    def pause(self, paused: bool) -> Reply:
        """Hold the run, or let it go on; idempotent."""
        if self.phase is Phase.FAULT:
            return Reply(False, f"fault, reset first: {self.fault}")
        if paused:
            said = "already paused" if self.phase is Phase.PAUSED else "paused"
            self._to(Phase.PAUSED)
            return Reply(True, said)
        if self.phase is not Phase.PAUSED:
            return Reply(True, f"not paused: {self.phase.value}")
        if self.begun:
            self._resume()
        else:
            self._to(Phase.WAITING)
        return Reply(True, self.phase.value)

    def step(self, samples: int = 1) -> Reply:
        """Advance a paused run by one sample or more, by the torques of the last command."""
        if self.phase is not Phase.PAUSED:
            return Reply(False, f"refused: only a paused run can be stepped, it is {self._said()}")
        if not self.begun and not self._begin():
            return Reply(False, "refused: there is no time yet on /clock")
        for _ in range(samples):
            self._board.refresh()
            try:
                if not self._control_period(paced=False):
                    return Reply(False, f"not done: {self._said()}")
            except RunStopped as stopped:
                self._fail(str(stopped))
                return Reply(False, self._said())
        return Reply(True, f"at {self.simulation.state.time_ns / 1e9:.9f} s")

    def reset(self) -> Reply:
        """Go back to the scene's initial state; stamps go on, the command is forgotten."""
        self._original.reset()
        self._start_anew(self._original)
        self.fault = ""
        self.counters.resets += 1
        if self.phase is not Phase.PAUSED:
            self._to(Phase.WAITING)
        return Reply(True, f"at the initial state, {self.phase.value}")

    def set_state(self, gamma: Triple, gamma_dot: Triple) -> Reply:
        """Put a run that waits or is paused at another state [rad], [rad/s]."""
        if self.phase not in (Phase.WAITING, Phase.PAUSED):
            return Reply(False, f"refused: pause or reset first, the run is {self._said()}")
        try:
            initial = Initial(gamma=gamma, gamma_dot=gamma_dot)
            scene = dataclasses.replace(self._original.scene, initial=initial)
            self._start_anew(self._build(scene))
        except SstError as error:
            return Reply(False, f"refused: {error}")
        self.counters.states_set += 1
        return Reply(True, f"the state is set, {self.phase.value}")

    def _start_anew(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self._board.clear()
        self.begun, self._tick = False, 0
        self._show()

    def _serve(self) -> None:
        self._asked.clear()
        while self._requests:
            request, answer = self._requests.popleft()
            try:
                answer.reply = request()
            finally:
                answer.done.set()

    def _wait_for_start(self) -> None:
        """Show the state until a command begins the run, where one has to."""
        shown = -math.inf
        while not self._asked.is_set():
            called = not self._settings.parameters.waits or self._board.look()
            if called and self._begin():
                self._resume()
                return
            if time.monotonic() - shown > IDLE_PERIOD_S:
                shown = time.monotonic()
                self._show()
            time.sleep(_POLL_S)

    def _begin(self) -> bool:
        """Publish the first sample; False as long as the clock has not begun."""
        self._start_ns = self._audience.begin_ns(
            self._stamp_ns + self._period_ns * self._ticks_per_sample
        )
        if self._start_ns == 0:
            return False
        self.begun = True
        self._publish()
        return True

    def _resume(self) -> None:
        self._to(Phase.RUNNING)
        self._board.refresh()
        self.counters.resume()
        self._pacer.start()

    def _to_the_next_sample(self) -> None:
        if self._control_period(paced=True) and self._tick >= self._last_tick:
            self._to(Phase.FINISHED)

    def _control_period(self, *, paced: bool) -> bool:
        """Tick to the next sample and publish it; False if there was none."""
        answer: Triple | None = None
        if self._settings.parameters.sync == "lockstep":
            answer = self._answered(paced)
            if answer is None:
                return False
        while True:
            if paced and not self._pacer.wait(self._stop.is_set):
                return False
            now = self.simulation.state
            self._advance(self._board.torque(now) if answer is None else answer)
            if self._tick % self._ticks_per_sample == 0 or self._tick >= self._last_tick:
                self._publish()
                return True

    def _advance(self, torque: Triple) -> None:
        moment, counters = self._board.moment, self.counters
        began = time.perf_counter()
        self.simulation.step(torque, self._period_ns, moment)
        counters.stepped(time.perf_counter() - began, self._pacer.late_ns)
        self._audience.tick(torque, moment)
        self._tick += 1

    def _answered(self, paced: bool) -> Triple | None:
        """Torques that answer the last sample; None if something else comes first."""
        timeout = self._settings.parameters.lockstep_timeout or math.inf
        began = time.monotonic()
        waited = 0.0
        while (answer := self._board.answer(self._stamp_ns)) is None:
            if self._stop.is_set() or (paced and self._asked.is_set()):
                return None
            if waited > timeout:
                said = f"no command answered the sample of {self._stamp_ns} ns within {timeout:g} s"
                if paced:
                    self._fail(said)
                return None
            time.sleep(min(max(waited / 10, 2e-5), _POLL_S))
            waited = time.monotonic() - began
        if waited * 1e9 > self._period_ns:
            self._pacer.start()  # to wait for an answer is no overrun
        return answer

    def _publish(self) -> None:
        self._stamp_ns = self._start_ns + self._tick * self._period_ns
        self._audience.sample(self.simulation.state, self._stamp_ns)
        self.counters.published += 1

    def _fail(self, reason: str) -> None:
        """Latch a fault; the last valid state is published, then held."""
        began = self.phase is not Phase.FAULT
        self.fault = self.fault or reason
        if began and self.begun and self._tick % self._ticks_per_sample:
            with contextlib.suppress(Exception):  # publishing may be what failed
                self._publish()
        self._to(Phase.FAULT)

    def _idle(self) -> None:
        self._show()
        self._asked.wait(IDLE_PERIOD_S)

    def _show(self) -> None:
        self._audience.idle(self.simulation.state, still=self.phase is Phase.FAULT)

    def _end_of_run(self) -> None:
        if self.phase is Phase.RUNNING and self._tick % self._ticks_per_sample:
            self._publish()
        self.counters.hold()
        self._stop.set()
        while self._requests:
            self._requests.popleft()[1].done.set()

    def _to(self, phase: Phase) -> None:
        if phase is not Phase.RUNNING:
            self.counters.hold()
        if phase is not self.phase:
            self.phase = phase
            self._tell()

    def _tell(self) -> None:
        self._audience.changed(self._said())

    def _said(self) -> str:
        return f"{self.phase.value}: {self.fault}" if self.fault else self.phase.value
