# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium that opens the page: for tests, and for the pictures in docs/."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sst_ros.errors import SstError

_FLAGS = (
    "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader"
    " --disable-background-networking --disable-component-update --disable-sync"
    " --no-first-run --hide-scrollbars"
)
_TIMEOUT_S = 120.0
"""Bound of every wait.

Without a graphics card a busy machine needs seconds to draw a frame.
"""


def chromium() -> tuple[str, str] | None:
    """Paths of an installed Chromium and its driver; None where one is missing."""
    path = shutil.which("chromium"), shutil.which("chromedriver")
    return (path[0], path[1]) if path[0] and path[1] else None


class Browser:
    """One window with one page."""

    def __init__(self, driver: Any) -> None:
        self._driver = driver

    def open(self, url: str, size: tuple[int, int]) -> None:
        """Open a page, of a size in pixels, in place of the last one.

        Errors of the last page are dropped.
        """
        self._driver.get("about:blank")
        self._driver.set_window_size(*size)
        # The window has borders; what counts is the page.
        inner = self._driver.execute_script(
            "return [window.innerWidth, window.innerHeight]"
        )
        self._driver.set_window_size(2 * size[0] - inner[0], 2 * size[1] - inner[1])
        self.complaints()
        self._driver.get(url)

    def text(self, selector: str) -> str:
        """Text of the element that a CSS selector finds; empty where there is none."""
        script = (
            "const e = document.querySelector(arguments[0]); return e ? e.textContent"
            " : ''"
        )
        return str(self._driver.execute_script(script, selector))

    def title(self) -> str:
        """Title of the browser's tab."""
        return str(self._driver.title)

    def time(self) -> float | None:
        """Time of the run that the page shows [s]; None where it shows none."""
        shown = self.text("#sst-time").removesuffix(" s")
        try:
            return float(shown)
        except ValueError:
            return None

    def press(self, label: str) -> None:
        """Click the button of this label."""
        self.until(lambda: self.enabled(label), f"button {label}")
        self._driver.execute_script("arguments[0].click()", self._buttons(label)[0])

    def enabled(self, label: str) -> bool:
        """Whether the button of this label is there and can be pressed."""
        names = self._buttons(label)
        return bool(names) and bool(names[0].is_enabled())

    def slide(self, label: str, keys: str) -> None:
        """Send keys to the slider of this label."""
        path = f"//*[normalize-space(text())='{label}']/following::*[@role='slider'][1]"
        self._driver.find_element("xpath", path).send_keys(keys)

    def _buttons(self, label: str) -> list[Any]:
        path = f"//button[normalize-space(.)='{label}']"
        return list(self._driver.find_elements("xpath", path))

    def hide(self, selector: str) -> None:
        """Hide what a CSS selector finds, now and later."""
        script = "document.head.insertAdjacentHTML('beforeend', arguments[0])"
        rule = f"<style>{selector} {{ display: none !important }}</style>"
        self._driver.execute_script(script, rule)

    def drawn(self) -> None:
        """Wait until all that has arrived is on the screen."""
        script = (
            "let n = 4; const done = arguments[0];"
            "const next = () => n-- ? requestAnimationFrame(next) : done(); next()"
        )
        self._driver.execute_async_script(script)

    def until(
        self, holds: Callable[[], bool], what: str, timeout: float = _TIMEOUT_S
    ) -> None:
        """Wait for a condition.

        Raises:
            SstError: it did not hold in time.

        """
        deadline = time.monotonic() + timeout
        while not holds():
            if time.monotonic() > deadline:
                raise SstError(f"no {what} on the page within {timeout:g} s")
            time.sleep(0.05)

    def picture(self, path: Path | None = None) -> bytes:
        """Take a PNG of the window, and keep it at a path."""
        from selenium.common.exceptions import TimeoutException

        taken = b""

        def succeeded() -> bool:
            nonlocal taken
            # the driver waits 10 s, a busy machine may need more
            with suppress(TimeoutException):
                taken = bytes(self._driver.get_screenshot_as_png())
            return bool(taken)

        self.until(succeeded, "picture")
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(taken)
        return taken

    def complaints(self) -> list[str]:
        """Return the errors on the browser's console since the last call."""
        entries = self._driver.get_log("browser")
        return [
            entry["message"]
            for entry in entries
            if entry["level"] in ("SEVERE", "ERROR")
        ]


@contextmanager
def browse() -> Iterator[Browser]:
    """Start a Chromium with a fresh profile; both are gone afterwards.

    Raises:
        SstError: there is no Chromium, or no driver of it.

    """
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    found = chromium()
    if found is None:
        raise SstError(
            "no chromium with chromedriver on the PATH: apt install chromium-driver"
        )
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = webdriver.ChromeOptions()
        options.binary_location = found[0]
        for flag in (*_FLAGS.split(), f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        driver = webdriver.Chrome(options=options, service=Service(found[1]))
        try:
            yield Browser(driver)
        finally:
            driver.quit()
