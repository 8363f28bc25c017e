# SPDX-License-Identifier: Apache-2.0
"""`view --scene` in headless Chromium: it loads, it moves, its buttons do what they say."""

import io
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from ros.conftest import Nodes, Observer, children, is_running
from std_msgs.msg import Float64MultiArray, String

pytest.importorskip("viser", reason="needs viser: pip install .[view]")
pytest.importorskip("selenium", reason="needs selenium: pip install .[test]")

from PIL import Image

from tools.browser import chromium

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(chromium() is None, reason="no chromium with chromedriver on the PATH"),
]
PICTURES = Path(__file__).parents[2] / "view_out"
RIGHT = "\ue014"
SIZE = (820, 560)
PANEL = 400


@pytest.fixture(scope="module")
def viewed(domain_of_module, browser):
    """The process, the page in a browser, and an observer of the topics."""
    started, watching = Nodes(), Observer(domain_of_module)
    process = started.start("view", "--scene", "swing", "--port", "18080")
    url = re.search(r"http://127\.0\.0\.1:\S+", started.line(process, 60)).group()
    browser.open(url, SIZE)
    browser.until(lambda: browser.time() is not None, "time of a run")
    watching.listen(String, "/sst_simulator/phase", latched=True)
    yield started, process, browser, watching
    watching.close()
    started.close()


def phase_is(watching, wanted):
    heard = watching.heard["/sst_simulator/phase"]
    watching.until(lambda: heard and heard[-1].data == wanted, f"phase {wanted}")


def canvas(page, name):
    """The picture left of the panel, as numbers."""
    taken = Image.open(io.BytesIO(page.picture(PICTURES / f"{name}.png"))).convert("L")
    return np.asarray(taken.crop((0, 0, SIZE[0] - PANEL, SIZE[1])), dtype=float)


def shown(page, joint):
    return float(page.text(f'[data-joint="{joint}"]') or "nan")


def test_it_loads_and_moves(viewed):
    _, _, page, _ = viewed
    page.until(lambda: np.isfinite(shown(page, "γ1")), "gamma_1")
    before, time, gamma = canvas(page, "moving_1"), page.time(), shown(page, "γ1")
    assert before.std() > 10.0  # something is drawn
    page.until(lambda: page.time() > time + 0.3, "later time")
    page.until(lambda: shown(page, "γ1") != gamma, "other angle")
    page.until(lambda: np.abs(canvas(page, "moving_2") - before).max() > 50.0, "other picture")
    assert "error estimate" in page.text("body")
    assert page.complaints() == []


def test_pause_step_and_resume(viewed):
    _, _, page, watching = viewed
    assert not page.enabled("Step")
    page.press("Pause")
    phase_is(watching, "paused")
    page.until(lambda: page.text("#sst-phase") == "paused", "phase paused")
    page.until(lambda: page.enabled("Step"), "button Step")
    held = page.time()
    page.press("Step")
    page.until(lambda: page.time() != held, "step")
    assert page.time() == pytest.approx(held + 0.01, abs=1e-9)
    page.press("Resume")
    phase_is(watching, "running")
    page.until(lambda: page.time() > held + 0.2, "motion after the pause")
    assert page.complaints() == []


def test_reset(viewed):
    _, _, page, watching = viewed
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
    _, _, page, watching = viewed
    commands = watching.listen(Float64MultiArray, "/sst_simulator/commands")
    page.slide("τ₂", RIGHT * 3)
    watching.until(lambda: commands and commands[-1].data[1] > 0.0, "torque of the slider")
    assert commands[-1].data[0] == commands[-1].data[2] == 0.0
    page.until(lambda: shown(page, "τ2") > 0.0, "torque on the page")
    canvas(page, "by_hand")
    page.press("Zero")
    watching.until(lambda: list(commands[-1].data) == [0.0, 0.0, 0.0], "no torque")
    rival = watching.publisher(Float64MultiArray, "/sst_simulator/commands")
    page.until(lambda: "commands come from" in page.text("body"), "name of the controller")
    assert not page.enabled("Zero")
    watching.node.destroy_publisher(rival)
    page.until(lambda: page.enabled("Zero"), "sliders without the controller")
    assert page.complaints() == []


def test_ctrl_c_ends_the_page_and_the_simulator(viewed):
    started, process, _, watching = viewed
    (simulator,) = children(process)
    status, _, errors = started.stop(process, signal.SIGINT, 30)
    assert status == 0 and "Traceback" not in errors
    watching.until(lambda: not is_running(simulator), "end of it", 5.0)
