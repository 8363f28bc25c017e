# SPDX-License-Identifier: Apache-2.0
"""The buttons and sliders of the page: for a running simulator, and for a recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from viser import GuiSliderHandle, Icon, ViserServer

from sst_ros.scene.scene import Scene
from sst_ros.view.source import Playback, RunControl, RunStatus, ViewState

_LARGEST = 5.0
"""Range of the torque sliders where the scene has no limit [N m]."""
_SPEEDS = ("0.1 ×", "0.25 ×", "0.5 ×", "1 ×", "2 ×", "5 ×")
_SHOWN_S = 4.0


class RunButtons:
    """Pause, step, reset, and manual torques while no controller commands the run."""

    def __init__(self, server: ViserServer, scene: Scene, controls: RunControl) -> None:
        self._controls, self._paused = controls, False
        gui = server.gui
        limit = scene.actuators.torque_limit if scene.actuators is not None else None
        most = limit or _LARGEST
        with gui.add_folder("run", order=1.0) as run:
            self._pause = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE)
            self._step = gui.add_button("Step", icon=Icon.PLAYER_SKIP_FORWARD, disabled=True)
            reset = gui.add_button("Reset", icon=Icon.REFRESH)
        with gui.add_folder("manual torques [N m]", order=5.0) as hand:
            self._note = gui.add_html("")
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
            slider.on_update(lambda event: self._apply() if event.client is not None else None)

    def remove(self) -> None:
        """Take them off the page."""
        for handle in self._owned:
            handle.remove()

    def show(self, state: ViewState | None, status: RunStatus) -> None:
        """Enable what is possible now."""
        paused = status.phase == "paused"
        if paused != self._paused:
            self._paused = paused
            self._pause.label = "Resume" if paused else "Pause"
            self._pause.icon = Icon.PLAYER_PLAY if paused else Icon.PLAYER_PAUSE
            self._step.disabled = not paused
        controller = self._controls.controller()
        for handle in (*self._sliders, self._zero):
            if handle.disabled != bool(controller):
                handle.disabled = bool(controller)
        note = f"<small>&nbsp; commands come from {controller}</small>" if controller else ""
        if note != self._note.content:
            self._note.content = note

    def _apply(self) -> None:
        first, second, third = (float(slider.value) for slider in self._sliders)
        self._controls.apply((first, second, third))

    def _release(self) -> None:
        for slider in self._sliders:
            _move(slider, 0.0)
        self._controls.apply((0.0, 0.0, 0.0))

    def _reset(self) -> tuple[bool, str]:
        if any(slider.value for slider in self._sliders):
            self._release()
        return self._controls.reset()


class PlaybackButtons:
    """Play, a time slider, and the speed of a recording."""

    def __init__(self, server: ViserServer, recording: Playback) -> None:
        self._recording, self._playing = recording, True
        gui = server.gui
        with gui.add_folder("recording", order=1.0) as folder:
            self._play = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE)
            self._time = gui.add_slider(
                "t [s]", 0.0, recording.length, recording.length / 1000.0, 0.0
            )
            speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1 ×")
        self._owned = (folder,)
        self._play.on_click(lambda _: recording.play(not recording.playing))
        self._time.on_update(
            lambda event: (
                recording.seek(float(self._time.value)) if event.client is not None else None
            )
        )
        speed.on_update(lambda _: recording.set_speed(float(speed.value.split()[0])))

    def remove(self) -> None:
        """Take them off the page."""
        for handle in self._owned:
            handle.remove()

    def show(self, state: ViewState | None, status: RunStatus) -> None:
        """Update button and slider."""
        before, playing = self._playing, self._recording.playing
        if playing != before:
            self._playing = playing
            self._play.label = "Pause" if playing else "Play"
            self._play.icon = Icon.PLAYER_PAUSE if playing else Icon.PLAYER_PLAY
        if (playing or before) and state is not None and state.time is not None:
            _move(self._time, round(min(state.time, self._recording.length), 6))


def _move(slider: GuiSliderHandle[float], value: float) -> None:
    slider.value = value  # type: ignore[misc]  # its setter does not follow its getter at once


def _click(name: str, act: Callable[[], tuple[bool, str]]) -> Callable[[Any], None]:
    """Return a handler that acts and notifies the client of a refusal."""

    def clicked(event: Any) -> None:
        done, message = act()
        if not done and event.client is not None:
            event.client.add_notification(
                f"{name} refused", message, auto_close_seconds=_SHOWN_S, color="red"
            )

    return clicked


def buttons(
    server: ViserServer, scene: Scene, controls: RunControl | Playback
) -> RunButtons | PlaybackButtons:
    """Add the controls that fit the source."""
    if isinstance(controls, Playback):
        return PlaybackButtons(server, controls)
    return RunButtons(server, scene, controls)
