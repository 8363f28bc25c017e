# SPDX-License-Identifier: Apache-2.0
"""Signals of a node."""

from programs import python

AMID = """
import signal, sys
from sst_ros.nodes import signals

def again(*_):
    "A second signal wherever the handler of the first is."
    if numbers:
        signal.raise_signal(numbers.pop())

numbers = [signal.SIGTERM, signal.SIGINT] * 20
signals.handle()
sys.setprofile(again)
signal.raise_signal(signal.SIGINT)
sys.setprofile(None)
print(signals.stop.is_set())
"""


def test_a_signal_within_the_handler_of_another_does_not_block():
    assert python(AMID, timeout=30).stdout == "True\n"
