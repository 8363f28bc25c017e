# SPDX-License-Identifier: Apache-2.0
"""`view` refuses what it cannot show, with a reason and without a traceback."""

import pytest

pytest.importorskip("viser", reason="needs viser: pip install .[view]")

from sst_ros.__main__ import main


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["no_such_bag"], "does not exist"),
        (["--scene", "no_such_scene"], "must be a readable .yaml file"),
        (["some_bag", "--scene", "swing"], "a bag or a scene, not both"),
    ],
)
def test_what_cannot_be_shown(words, said, capsys):
    assert main(["view", *words]) == 1
    assert said in capsys.readouterr().err
