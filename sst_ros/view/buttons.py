# SPDX-License-Identifier: Apache-2.0
"""The buttons and sliders of the page: for a running simulator, and for a recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from viser import GuiSliderHandle, Icon, ViserServer

from sst_ros.scene.scene import Scene
from sst_ros.view.source import Controls, Health, Reel, Sample

_LARGEST = 5.0
"""Range of the torque sliders where the scene has no limit [N m]."""
_SPEEDS = ("0.1 ×", "0.25 ×", "0.5 ×", "1 ×", "2 ×", "5 ×")
_SHOWN_S = 4.0


class RunButtons:
    """Pause, step, reset, and torques by hand as long as no controller drives the run."""

    def __init__(self, server: ViserServer, scene: Scene, controls: Controls) -> None:
        self._controls, self._paused = controls, False
        gui = server.gui
        limit = scene.actuators.torque_limit if scene.actuators is not None else None
        most = limit or _LARGEST
        with gui.add_folder("run", order=1.0) as run:
            self._pause = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE)
            self._step = gui.add_button("Step", icon=Icon.PLAYER_SKIP_FORWARD, disabled=True)
            reset = gui.add_button("Reset", icon=Icon.REFRESH)
        with gui.add_folder("torques by hand [N m]", order=5.0) as hand:
            self._told = gui.add_html("")
            self._sliders = [
                gui.add_slider(f"τ{'₁₂₃'[k]}", -most, most, most / 100.0, 0.0) for k in range(3)
            ]
            self._zero = gui.add_button("Zero", icon=Icon.CIRCLE_OFF)
        self._owned = (run, hand)
        self._pause.on_click(_click("pause", lambda: controls.pause(not self._paused)))
        self._step.on_click(_click("step", controls.step))
        reset.on_click(_click("reset", self._reset))
        self._zero.on_click(lambda _: self._release())
        for slider in self._sliders:
            slider.on_update(lambda event: self._drive() if event.client is not None else None)

    def remove(self) -> None:
        """Take them off the page."""
        for handle in self._owned:
            handle.remove()

    def show(self, sample: Sample | None, health: Health) -> None:
        """Offer what can be done now."""
        paused = health.phase == "paused"
        if paused != self._paused:
            self._paused = paused
            self._pause.label = "Resume" if paused else "Pause"
            self._pause.icon = Icon.PLAYER_PLAY if paused else Icon.PLAYER_PAUSE
            self._step.disabled = not paused
        driver = self._controls.driven_by()
        for handle in (*self._sliders, self._zero):
            if handle.disabled != bool(driver):
                handle.disabled = bool(driver)
        told = f"<small>&nbsp; {driver} drives the run</small>" if driver else ""
        if told != self._told.content:
            self._told.content = told

    def _drive(self) -> None:
        first, second, third = (float(slider.value) for slider in self._sliders)
        self._controls.drive((first, second, third))

    def _release(self) -> None:
        for slider in self._sliders:
            _move(slider, 0.0)
        self._controls.drive((0.0, 0.0, 0.0))

    def _reset(self) -> tuple[bool, str]:
        if any(slider.value for slider in self._sliders):
            self._release()
        return self._controls.reset()


class ReelButtons:
    """Play, a time slider, and the speed of a recording."""

    def __init__(self, server: ViserServer, reel: Reel) -> None:
        self._reel, self._playing = reel, True
        gui = server.gui
        with gui.add_folder("recording", order=1.0) as folder:
            self._play = gui.add_button("Hold", icon=Icon.PLAYER_PAUSE)
            self._time = gui.add_slider("t [s]", 0.0, reel.length, reel.length / 1000.0, 0.0)
            speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1 ×")
        self._owned = (folder,)
        self._play.on_click(lambda _: reel.play(not reel.playing))
        self._time.on_update(
            lambda event: reel.seek(float(self._time.value)) if event.client is not None else None
        )
        speed.on_update(lambda _: reel.speed(float(speed.value.split()[0])))

    def remove(self) -> None:
        """Take them off the page."""
        for handle in self._owned:
            handle.remove()

    def show(self, sample: Sample | None, health: Health) -> None:
        """Move the slider along."""
        before, playing = self._playing, self._reel.playing
        if playing != before:
            self._playing = playing
            self._play.label = "Hold" if playing else "Play"
            self._play.icon = Icon.PLAYER_PAUSE if playing else Icon.PLAYER_PLAY
        if (playing or before) and sample is not None and sample.time is not None:
            _move(self._time, round(min(sample.time, self._reel.length), 6))


def _move(slider: GuiSliderHandle[float], value: float) -> None:
    slider.value = value  # type: ignore[misc]  # its setter does not follow its getter at once


def _click(name: str, act: Callable[[], tuple[bool, str]]) -> Callable[[Any], None]:
    """Act; tell who clicked if it was refused. What is done the page shows by itself."""

    def clicked(event: Any) -> None:
        done, said = act()
        if not done and event.client is not None:
            event.client.add_notification(
                f"{name} refused", said, auto_close_seconds=_SHOWN_S, color="red"
            )

    return clicked


def buttons(
    server: ViserServer, scene: Scene, controls: Controls | Reel
) -> RunButtons | ReelButtons:
    """Make what fits the source."""
    if isinstance(controls, Reel):
        return ReelButtons(server, controls)
    return RunButtons(server, scene, controls)
