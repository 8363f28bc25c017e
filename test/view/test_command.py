# SPDX-License-Identifier: Apache-2.0
"""`view` refuses what it cannot show, with a reason and without a traceback."""

import pytest

pytest.importorskip("viser", reason="needs viser: pip install .[view]")

from sst_ros.__main__ import main
from sst_ros.errors import InputError
from sst_ros.view.page import LOCAL, LocalServer, Page


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


class Nothing:
    scene = None


@pytest.mark.parametrize("host", ["203.0.113.1", "no.such.host.invalid", "\ud800"])
def test_other_machines_addresses(host):
    with pytest.raises(InputError, match="address of this machine"):
        Page(Nothing(), host)


def test_two_pages_take_two_ports_and_nothing_is_shared():
    first, second = Page(Nothing(), port=18280), Page(Nothing(), port=18280)
    assert first.url != second.url
    assert first.url.startswith(f"http://{LOCAL}:")
    assert first._server.request_share_url() is None
    assert isinstance(first._server, LocalServer)
    first.close()
    second.close()
