"""A browser without a window, in which pictures of the viewer are made."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pbfd_torch.errors import InputError

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
)


@contextmanager
def page(width: int, height: int, offline: bool = False) -> Iterator[Any]:
    """A page of playwright's in headless Chromium or Chrome, `width` × `height` pixels. offline: without any network.

    Raises `InputError` where playwright or the browser is not installed."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise InputError("pictures need the package playwright: pip install 'pbfd_torch[film]'") from None
    executable = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    with sync_playwright() as driver, tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        try:
            context = driver.chromium.launch_persistent_context(
                profile,
                executable_path=executable,
                headless=True,
                args=list(_FLAGS),
                viewport={"width": width, "height": height},
                offline=offline,
            )
        except Exception as error:  # playwright's own, of many kinds
            names = ", ".join(BROWSERS)
            raise InputError(
                f"no browser could be started ({str(error).splitlines()[0]}): install one of {names}, for example with "
                "'apt install chromium', or run 'playwright install chromium'"
            ) from error
        try:
            yield context.pages[0]
        finally:
            context.close()
