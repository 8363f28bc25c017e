# SPDX-License-Identifier: Apache-2.0
"""A bag on the page: the source by itself, and the page in headless Chromium."""

import re
import select
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sst_ros.recording.recording import read

pytest.importorskip("viser", reason="needs viser: pip install .[view]")
pytest.importorskip("selenium", reason="needs selenium: pip install .[test]")

from sst_ros.view import source
from tools.browser import chromium

PICTURES = Path(__file__).parents[2] / "view_out"
RIGHT, HOME = "\ue014", "\ue011"


class Clock:
    def __init__(self, monkeypatch):
        self.now = 100.0
        monkeypatch.setattr(source.time, "monotonic", lambda: self.now)


def test_it_plays_every_sample_once_and_ends(example2_bag, monkeypatch):
    clock, run = Clock(monkeypatch), read(example2_bag)
    reel = source.Replay(example2_bag)
    seen = list(reel.states())
    while reel.playing:
        clock.now += 1.0 / 30.0
        seen += reel.states()
    assert [sample.time for sample in seen] == run.seconds.tolist()
    assert np.array([sample.gamma for sample in seen]) == pytest.approx(
        run.gamma, abs=0.0
    )
    assert np.array([sample.torque for sample in seen]) == pytest.approx(
        run.effort, abs=0.0
    )


def test_hold_seek_and_speed(example2_bag, monkeypatch):
    clock = Clock(monkeypatch)
    reel = source.Replay(example2_bag)
    reel.set_speed(0.5)
    clock.now += 0.2
    assert reel.states()[-1].time == pytest.approx(0.1)
    reel.play(False)
    clock.now += 10.0
    assert not reel.states()
    reel.seek(0.25)
    assert reel.states()[-1].time == pytest.approx(0.25)
    reel.seek(0.02)  # back: the path begins anew
    back = reel.states()
    assert back[0].time == 0.0 and back[-1].time == pytest.approx(0.02)
    reel.seek(99.0)
    reel.play(True)  # from the beginning, as it has ended
    assert reel.states()[-1].time == 0.0


@pytest.mark.skipif(
    chromium() is None, reason="no chromium with chromedriver on the PATH"
)
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_page_of_a_bag(example2_bag, browser):
    command = [
        sys.executable,
        "-m",
        "sst_ros",
        "view",
        str(example2_bag),
        "--port",
        "18180",
    ]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as process:
        try:
            assert select.select([process.stdout], [], [], 60)[0]
            url = re.search(
                r"http://127\.0\.0\.1:\S+", process.stdout.readline()
            ).group()
            page = browser
            page.open(url, (960, 640))
            page.until(lambda: page.title() == "sst_ros", "title of the tab")
            page.until(
                lambda: page.text("#sst-phase") == "recording, paused", "end of the bag"
            )
            assert page.time() == 0.3
            page.slide("t [s]", HOME)
            page.until(lambda: page.time() == 0.0, "beginning of the bag")
            page.slide("t [s]", RIGHT * 20)
            page.until(lambda: page.time() > 0.0, "later time")
            page.press("Play")
            page.until(lambda: page.time() == 0.3, "end of the bag")
            page.picture(PICTURES / "recording.png")
            assert page.complaints() == []
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=30)
            assert process.returncode == 0 and "Traceback" not in errors
        finally:
            if process.poll() is None:
                process.kill()
