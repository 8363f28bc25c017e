# SPDX-License-Identifier: Apache-2.0
"""The request for short exit latencies of idle states, against a file in place of the
device.
"""

import sys

import pytest

from sst_ros.runtime.scheduling import CpuDmaLatency


@pytest.mark.parametrize("latency_us", [0, 20])
def test_a_request_is_written_as_the_kernel_reads_it(tmp_path, latency_us):
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    asked = CpuDmaLatency(device)
    assert asked.request(latency_us) == f"{latency_us} us"
    assert device.read_bytes() == latency_us.to_bytes(4, sys.byteorder)
    assert asked.request(latency_us) == f"{latency_us} us"
    assert len(device.read_bytes()) == 4  # one request, made once
    assert asked.request(-1) == "no limit"
    assert asked.request(-1) == "no limit"


def test_what_is_not_permitted_is_said_and_nothing_is_opened(tmp_path):
    assert CpuDmaLatency(tmp_path / "none").request(-1) == "no limit"
    said = CpuDmaLatency(tmp_path).request(0)  # a folder cannot be written
    assert (
        said.startswith("no limit: 0 us is not permitted (") and str(tmp_path) in said
    )
    said = CpuDmaLatency(tmp_path / "none").request(5)
    assert (
        said.startswith("no limit: 5 us is not permitted (") and "No such file" in said
    )
