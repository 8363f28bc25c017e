# SPDX-License-Identifier: Apache-2.0
"""A study on real `dask scheduler` and `dask worker` processes: killed, replaced,
refused, full.
"""

import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pytest
from sweeps.test_sweep import same

from sst_ros import load_scene
from sst_ros.sweeps import cluster
from sst_ros.sweeps.cluster import SweepFailed, connect
from sst_ros.sweeps.sweep import run_study
from sst_ros.sweeps.sweep_study import SweepStudy

for module in ("distributed", "pandas", "pyarrow"):
    pytest.importorskip(module, reason="a cluster needs it")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
]
LIMIT_S = 60
VARY = {
    "star.inertia": ("uniform", 0.9, 1.1, "relative"),
    "initial.gamma": ("uniform", 0.7, 0.85),
}
STUDY = SweepStudy(
    load_scene("example2_heavy"), VARY, n=1200, seed=7, steps=40, chunk=100
)
WORKER = "from distributed.cli.dask_worker import main; main()"
OLD = "from sst_ros import version; version.VERSION = '0.0.9'"
FULL = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))"
BEFORE_A_CHUNK = """
import os, signal, time
from sst_ros.sweeps.sweep import PreparedSweep
compute = PreparedSweep.chunk
def patched(self, index):
    {}
    return compute(self, index)
PreparedSweep.chunk = patched
"""
POISONED = BEFORE_A_CHUNK.format("index == 3 and os.kill(os.getpid(), signal.SIGKILL)")
NOTED = BEFORE_A_CHUNK.format(
    "open('noted', 'a').write(f'{index}\\n'); time.sleep(0.3)"
)
SLOW = BEFORE_A_CHUNK.format("time.sleep(0.1)")


@pytest.fixture(scope="module")
def expected():
    return run_study(STUDY, None)


class Processes:
    """A scheduler and workers of a test, in folders of its own."""

    def __init__(self, folder):
        self.folder, self.workers = folder, []
        self.environment = os.environ | {
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "3"
        }
        self.start_scheduler()

    def start(self, words):
        given = {"env": self.environment, "cwd": self.folder}
        return subprocess.Popen([sys.executable, *words], **given)

    def start_scheduler(self):
        self.file = file = self.folder / f"scheduler_{time.monotonic_ns()}.json"
        words = ["-m", "distributed.cli.dask_scheduler", "--port", "0",
                 "--host", "127.0.0.1", "--no-dashboard",
                 "--scheduler-file", str(file)]  # fmt: skip
        self.scheduler = self.start(words)
        until(lambda: file.exists() and file.stat().st_size > 0)

    def add_worker(self, patch=""):
        words = [
            "-c", f"{patch}\n{WORKER}", "--scheduler-file", str(self.file),
            "--nthreads", "1", "--no-dashboard", "--local-directory",
            str(self.folder / "work"), "--no-nanny",
        ]  # fmt: skip
        self.workers.append(self.start(words))
        return self.workers[-1]

    @contextmanager
    def client(self, workers):
        found = connect(json.loads(self.file.read_text())["address"])
        try:
            found.wait_for_workers(workers, timeout=LIMIT_S)
            yield found
        finally:
            found.close(timeout=5)

    def stop(self):
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait(LIMIT_S)
        self.workers.clear()


@pytest.fixture
def processes(tmp_path):
    started = Processes(tmp_path)
    yield started
    started.stop()


@contextmanager
def meanwhile(work, *over):
    """Let a thread work until it ends, or notices that what is done here is over."""
    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        for event in over:
            event.set()
        thread.join(LIMIT_S)


def until(condition):
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def test_a_cluster_gives_the_bits_of_threads(processes, expected, tmp_path):
    processes.add_worker()
    processes.add_worker()
    with processes.client(2) as client:
        same(run_study(STUDY, tmp_path / "out", client=client), expected)


def test_workers_killed_at_random_lose_nothing(processes, tmp_path):
    study = dataclasses.replace(STUDY, n=2000, chunk=10)
    assert study.chunks == 200
    for _ in range(2):
        processes.add_worker(SLOW)
    rng, over = random.Random(3), threading.Event()

    def kill():
        for _ in range(6):
            if over.wait(rng.uniform(0.5, 2.0)):
                return
            victim = rng.choice(
                [one for one in processes.workers if one.poll() is None]
            )
            victim.kill()
            processes.add_worker(SLOW)

    with processes.client(2) as client, meanwhile(kill, over):
        found = run_study(study, tmp_path / "out", client=client)
    assert sum(one.poll() is not None for one in processes.workers) >= 3
    assert found.index.tolist() == list(range(2000))
    assert len(list((tmp_path / "out").glob("part-*.parquet"))) == 200
    same(found, run_study(study, None))


def test_a_worker_that_stands_still_holds_no_study(processes, expected, tmp_path):
    processes.stop()
    processes.environment["DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL"] = "5s"
    processes.start_scheduler()
    still = processes.add_worker(SLOW)
    processes.add_worker(SLOW)

    def stop():
        until(lambda: len(list((tmp_path / "out").glob("part-*"))) >= 3)
        still.send_signal(signal.SIGSTOP)

    with processes.client(2) as client, meanwhile(stop):
        same(run_study(STUDY, tmp_path / "out", client=client), expected)


def test_a_study_resumes_after_its_scheduler_was_killed(
    processes, expected, tmp_path, monkeypatch
):
    monkeypatch.setattr(cluster, "NO_SCHEDULER", 3.0)
    processes.add_worker(SLOW)
    out = tmp_path / "out"

    def kill():
        until(lambda: len(list(out.glob("part-*"))) >= 3)
        processes.scheduler.kill()

    failed = pytest.raises(
        SweepFailed, match="scheduler does not answer; continue with --resume"
    )
    with processes.client(1) as client, meanwhile(kill), failed:
        run_study(STUDY, out, client=client)
    done = len(list(out.glob("part-*")))
    assert 3 <= done < 12
    processes.stop()
    processes.start_scheduler()
    processes.add_worker()
    with processes.client(1) as client:
        same(run_study(STUDY, out, client=client, resume=True), expected)


@pytest.mark.parametrize(
    ("patch", "reason"),
    [(OLD, "sst_ros 0.0.9 in place of"), (FULL, "File too large")],
    ids=["another version", "no space left"],
)
def test_a_worker_that_cannot_do_it_gets_no_more_chunks(
    processes, expected, tmp_path, capsys, patch, reason
):
    processes.add_worker(patch)
    processes.add_worker(NOTED)

    def join():
        until(lambda: len(list((tmp_path / "out").glob("part-*"))) >= 3)
        processes.add_worker(NOTED)

    with processes.client(2) as client, meanwhile(join):
        same(run_study(STUDY, tmp_path / "out", client=client), expected)
    # What the workers that fit have begun is not begun again when another is refused,
    # or joins.
    assert sorted(map(int, (tmp_path / "noted").read_text().split())) == list(range(12))
    said = capsys.readouterr().err
    assert "gets no more chunks: " in said
    assert reason in said
    assert not list((tmp_path / "out").glob(".part-*"))


def test_without_a_worker_that_takes_chunks_the_study_ends(
    processes, tmp_path, monkeypatch
):
    monkeypatch.setattr(cluster, "NO_WORKER", 2.0)
    processes.add_worker(OLD)
    with (
        processes.client(1) as client,
        pytest.raises(SweepFailed, match=r"in place of"),
    ):
        run_study(STUDY, tmp_path / "out", client=client)


@pytest.mark.parametrize("allowed", [0, 2])
def test_a_chunk_that_kills_its_workers_is_given_up_at_last(
    processes, expected, tmp_path, allowed
):
    processes.stop()
    processes.environment |= {
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(allowed)
    }
    processes.start_scheduler()
    live = threading.Event()

    def keep_one():
        """Start a worker whenever there is none, as a nanny or SLURM does."""
        while not live.wait(0.1):
            if all(one.poll() is not None for one in processes.workers):
                processes.add_worker(POISONED)

    died = pytest.raises(
        SweepFailed, match=r"^chunk 3: [^;]*died while running it[^;]*$"
    )
    with meanwhile(keep_one, live), processes.client(1) as client, died:
        run_study(STUDY, tmp_path / "out", client=client)
    assert len(list((tmp_path / "out").glob("part-*"))) == 11
    same(run_study(STUDY, tmp_path / "out", resume=True), expected)
