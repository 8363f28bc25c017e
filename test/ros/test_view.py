# SPDX-License-Identifier: Apache-2.0
"""`view --scene` in headless Chromium: it loads, it moves, its buttons do what they
say.
"""

import io
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from ros.conftest import COMMANDS, children, is_running
from std_msgs.msg import Float64MultiArray

pytest.importorskip("viser", reason="needs viser: pip install .[view]")
pytest.importorskip("selenium", reason="needs selenium: pip install .[test]")

from PIL import Image

from tools.browser import browse, chromium

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(
        chromium() is None, reason="no chromium with chromedriver on the PATH"
    ),
]
SOURCE = Path(__file__).parents[2]
LIMIT_S = 180.0
PICTURES = SOURCE / "view_out"
RIGHT = "\ue014"
SIZE = (820, 560)
PANEL = 400


@pytest.fixture(scope="module")
def viewed(nodes_of_module, observer_of_module, browser):
    """The process, the page in a browser, and an observer of the topics."""
    process = nodes_of_module.start("view", "--scene", "swing", "--port", "18080")
    url = re.search(
        r"http://127\.0\.0\.1:\S+", nodes_of_module.line(process, 60)
    ).group()
    browser.open(url, SIZE)
    browser.until(lambda: browser.time() is not None, "time of a run")
    assert observer_of_module.phases is not None  # it listens from now on
    return process, browser, observer_of_module


def canvas(page, name):
    """The picture left of the panel, as numbers."""
    taken = Image.open(io.BytesIO(page.picture(PICTURES / f"{name}.png"))).convert("L")
    return np.asarray(taken.crop((0, 0, SIZE[0] - PANEL, SIZE[1])), dtype=float)


def shown(page, joint):
    return float(page.text(f'[data-joint="{joint}"]') or "nan")


def test_it_loads_and_moves(viewed):
    _, page, _ = viewed
    page.until(lambda: np.isfinite(shown(page, "γ1")), "gamma_1")
    before, time, gamma = canvas(page, "moving_1"), page.time(), shown(page, "γ1")
    assert before.std() > 10.0  # something is drawn
    page.until(lambda: page.time() > time + 0.3, "later time")
    page.until(lambda: shown(page, "γ1") != gamma, "other angle")
    page.until(
        lambda: np.abs(canvas(page, "moving_2") - before).max() > 50.0, "other picture"
    )
    assert "error estimate" in page.text("body")
    assert page.complaints() == []


def test_pause_step_and_resume(viewed):
    _, page, watching = viewed
    assert not page.enabled("Step")
    page.press("Pause")
    watching.phase("paused")
    page.until(lambda: page.text("#sst-phase") == "paused", "phase paused")
    page.until(lambda: page.enabled("Step"), "button Step")
    held = page.time()
    page.press("Step")
    page.until(lambda: page.time() != held, "step")
    assert page.time() == pytest.approx(held + 0.01, abs=1e-9)
    page.press("Resume")
    watching.phase("running")
    page.until(lambda: page.time() > held + 0.2, "motion after the pause")
    assert page.complaints() == []


def test_reset(viewed):
    _, page, watching = viewed
    page.until(lambda: page.time() > 1.0, "some time")
    page.press("Pause")
    page.until(lambda: page.text("#sst-phase") == "paused", "phase paused")
    before = page.time()
    page.press("Reset")
    watching.told("resets", 1)
    page.until(lambda: page.time() is None, "state without a time")
    page.press("Resume")
    page.until(lambda: page.time() is not None, "time of a new run")
    assert page.time() < before


def test_torques_by_hand_until_a_controller_comes(viewed):
    _, page, watching = viewed
    commands = watching.listen(Float64MultiArray, COMMANDS)
    page.slide("τ₂", RIGHT * 3)
    watching.until(
        lambda: commands and commands[-1].data[1] > 0.0, "torque of the slider"
    )
    assert commands[-1].data[0] == commands[-1].data[2] == 0.0
    page.until(lambda: shown(page, "τ2") > 0.0, "torque on the page")
    canvas(page, "by_hand")
    page.press("Zero")
    watching.until(lambda: list(commands[-1].data) == [0.0, 0.0, 0.0], "no torque")
    rival = watching.publisher(Float64MultiArray, COMMANDS)
    page.until(
        lambda: "commands come from" in page.text("body"), "name of the controller"
    )
    assert not page.enabled("Zero")
    watching.node.destroy_publisher(rival)
    page.until(lambda: page.enabled("Zero"), "sliders without the controller")
    assert page.complaints() == []


def test_ctrl_c_ends_the_page_and_the_simulator(viewed, nodes_of_module):
    process, _, watching = viewed
    (simulator,) = children(process)
    assert nodes_of_module.stop(process, signal.SIGINT, 30)[0] == 0
    watching.until(lambda: not is_running(simulator), "end of it", 5.0)


def test_make_view_in_a_copy_that_has_nothing_yet(tmp_path, domain):
    """A page that moves within three minutes."""
    ignored = shutil.ignore_patterns(
        ".*", "*_out*", "__pycache__", "*.egg-info", "build", "site"
    )
    copy = shutil.copytree(SOURCE, tmp_path / "sst_ros", ignore=ignored)
    began = time.monotonic()
    # A session of its own: Ctrl-C in a terminal reaches make, the page and the
    # simulator.
    process = subprocess.Popen(
        ["make", "view", f"PYTHON={sys.executable}"],
        cwd=copy,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        lines = iter(process.stdout.readline, "")
        url = next(
            filter(None, (re.search(r"http://\S+", line) for line in lines))
        ).group()
        with browse() as page:
            page.open(url, SIZE)
            page.until(lambda: page.time() is not None, "time of a run")
            first = page.time()
            page.until(lambda: page.time() > first, "motion")
            taken = time.monotonic() - began
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert "Traceback" not in errors
    assert taken < LIMIT_S
    print(f"make view: a page that moves after {taken:.0f} s")
