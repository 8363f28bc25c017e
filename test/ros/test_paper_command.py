# SPDX-License-Identifier: Apache-2.0
"""`make paper`: Figs. 8 to 14 with the continuous solution and an independent engine."""

import pytest

from studies.paper import main, paper

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(180)]
PICTURES = [
    "fig08_position_of_E", "fig09_psi", "fig09_inverse_dynamics", "fig10_path_of_E",
    "fig11_position_of_E", "fig12_theta", "fig13_phi", "fig14_psi",
]  # fmt: skip


def test_the_figures_are_drawn_and_their_curves_agree(tmp_path, domain, capsys):
    pytest.importorskip("pinocchio", reason="Pinocchio is missing: pip install pin")
    found = paper(tmp_path / "out")
    printed = capsys.readouterr().out
    limits = {(each.scene, each.what.partition(" ")[0]): each for each in found}
    for name in ("example1", "example2"):
        assert limits[name, "nodes"].value <= 5e-5
        assert limits[name, "Pinocchio"].value <= 1e-9
    assert limits["example1", "torques"].value <= 1e-8
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    for each in found:
        assert each.within and str(each) in page and str(each) in printed
    for name in PICTURES:
        assert (tmp_path / "out" / f"{name}.png").stat().st_size > 10_000
        assert f"{name}.png" in page
    assert "ssumed inertias" in page
    assert main(["--out", str(tmp_path / "out")]) == 1
    assert "exists already" in capsys.readouterr().err
