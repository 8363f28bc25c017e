# SPDX-License-Identifier: Apache-2.0
"""The simulation on the first page of the documentation, in a browser, against
`simulate`.
"""

import importlib.util
import json

import numpy as np
import pytest
from docs.blocks import ROOT
from scipy.spatial.transform import Rotation

from sst_ros import load_scene, simulate
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.traced_dynamics import Dynamics

pytest.importorskip("selenium", reason="needs selenium: pip install .[test]")

from tools.browser import browse, chromium

pytestmark = [
    pytest.mark.skipif(
        chromium() is None, reason="no chromium with chromedriver on the PATH"
    ),
    pytest.mark.slow,
    pytest.mark.timeout(600),
]
TORQUE = [0.4, -0.3, 0.2]
PAGE = """<!doctype html><meta charset="utf-8"><div id="live-manipulator"></div>
<script src="live_equations.js"></script><script src="live.js"></script>
<pre id="found"></pre>
<script>
let y = manipulator.initial;
for (let n = 0; n < 1000; n += 1) y = advance(y, {torque});
const slopes = {states}.map((state) => derivative(0.0, ...state, ...{torque}));
const turned = pose(joints(...y)).star;
document.querySelector("#found").textContent = JSON.stringify({{ y, slopes, turned }});
</script>"""


@pytest.fixture(scope="module")
def equations():
    spec = importlib.util.spec_from_file_location(
        "live_equations", ROOT / "docs/live_equations.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_has_the_equations_and_the_motion_of_simulate(equations, tmp_path):
    scene = equations.live_scene()
    around = np.random.default_rng(7).normal(0.0, 0.1, (200, 7))
    states = (np.array(start_of(scene)) + around).tolist()
    texts = {
        "live_equations.js": equations.write_equations(scene),
        "live.js": (ROOT / "docs/_static/live.js").read_text(encoding="utf-8"),
        "page.html": PAGE.format(torque=json.dumps(TORQUE), states=json.dumps(states)),
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    with browse() as page:
        page.open((tmp_path / "page.html").as_uri(), (900, 900))
        page.until(lambda: page.text("#found"), "result")
        found = json.loads(page.text("#found"))
        page.until(
            lambda: "t = 0.5" in page.text(".live-status"), "half a second of motion"
        )
        page.press("Pause")
        page.press("Zero torques")
        page.until(lambda: page.enabled("Resume"), "button Resume")
        page.press("Reset")
        page.until(lambda: "t = 0.00 s" in page.text(".live-status"), "beginning")
        assert page.complaints() == []
    expected = [Dynamics.of(scene).derivative(*state, *TORQUE) for state in states]
    # The browser's own sin, cos and atan2 may differ in the last bit.
    assert np.array(found["slopes"]) == pytest.approx(
        np.array(expected), rel=1e-11, abs=1e-11
    )
    motion = simulate(scene, TORQUE, 1.0, tolerance=1e-10)
    assert motion.success
    quaternion, body_rate = motion.quaternion[-1], motion.body_rate[-1]
    assert abs(np.dot(found["y"][:4], quaternion)) == pytest.approx(1.0, abs=1e-12)
    assert found["y"][4:] == pytest.approx(body_rate, abs=1e-6)
    turned = Rotation.from_quat(quaternion).as_matrix()
    assert np.array(found["turned"]) == pytest.approx(turned, abs=1e-6)


def test_past_a_limit_the_page_keeps_the_last_valid_state(equations, tmp_path):
    scene = load_scene("example2_heavy").with_values({"actuators.torque_limit": 6.0})
    start = "<script>document.querySelectorAll('input')[0].value = 6;</script>"
    for name, text in {
        "live_equations.js": equations.write_equations(scene),
        "live.js": (ROOT / "docs/_static/live.js").read_text(encoding="utf-8"),
        "page.html": PAGE.format(torque="[0, 0, 0]", states="[]") + start,
    }.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    with browse() as page:
        page.open((tmp_path / "page.html").as_uri(), (900, 900))
        page.until(
            lambda: "stopped: gamma_1" in page.text(".live-status"),
            "stop at the stroke",
        )
        text = page.text(".live-status")
        page.drawn()
        assert page.text(".live-status") == text
        page.press("Reset")
        page.until(lambda: "stopped" not in page.text(".live-status"), "new beginning")
        assert page.complaints() == []
