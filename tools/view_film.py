# SPDX-License-Identifier: Apache-2.0
"""The moving picture of the page in the README: `python -m tools.view_film docs/view.webp`.

It films what `make view` shows, of a run in slow motion, so that the film is as smooth as the
motion is, however slowly a machine without graphics draws.
"""

from __future__ import annotations

import io
import re
import signal
import subprocess
import sys
from datetime import date
from pathlib import Path

from sst_ros.errors import SstError
from sst_ros.view.source import simulator
from tools.browser import Browser, browse

SCENE = "swing"
WINDOW = (1040, 700)
WIDTH = 900
FRAMES, RATE = 75, 25
"""Pictures, and how many make a second of the run and of the film."""
SLOW = 0.01
"""Time of the run per time."""
_QUALITY = 55


def film(path: Path) -> None:
    """Write the film as an animated WebP.

    Raises:
        SstError: there is no browser, or the page does not do what it should.

    """
    from PIL import Image

    command = [sys.executable, "-m", "sst_ros", "view"]
    with (
        simulator(SCENE, SLOW),
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process,
    ):
        try:
            assert process.stdout is not None
            found = re.search(r"http://\S+", process.stdout.readline())
            if found is None:
                raise SstError("`view` printed no address")
            with browse() as page:
                page.open(found.group(), WINDOW)
                taken = [Image.open(io.BytesIO(png)).convert("RGB") for png in _pictures(page)]
        finally:
            process.send_signal(signal.SIGINT)
    size = (WIDTH, WIDTH * WINDOW[1] // WINDOW[0])
    frames = [picture.resize(size, Image.Resampling.LANCZOS) for picture in taken]
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=1000 // RATE,
        loop=0,
        quality=_QUALITY,
        method=6,
    )
    print(f"{path}: {len(frames)} frames, {path.stat().st_size / 1e6:.2f} MB, {date.today()}")


def _pictures(page: Browser) -> list[bytes]:
    page.until(lambda: page.time() is not None, "time of a run")
    page.hide(".mantine-Notification-root")
    begin, taken = page.time() or 0.0, []
    for frame in range(FRAMES):
        _wait(page, begin + (frame + 1) / RATE)
        taken.append(page.picture())
    return taken


def _wait(page: Browser, time: float) -> None:
    page.until(lambda: (page.time() or 0.0) >= time - 1e-9, f"time {time:.2f} s")
    page.drawn()


if __name__ == "__main__":
    film(Path(sys.argv[1]))
