"""Pictures of a page, where there is a browser."""

import os
import subprocess
from pathlib import Path
from shutil import which
from tempfile import TemporaryDirectory

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SIZES = {"page": (1200, 1250), "page_phone": (420, 1700)}  # pixels
Screenshots = dict[str, bytes]


def screenshots(url: str) -> Screenshots:
    """PNG files by name: as on a desk and as on a phone; none without a browser."""
    browser = next(filter(None, map(which, BROWSERS)), None)
    if browser is None:
        return {}
    return {name: _screenshot(browser, url, *size) for name, size in SIZES.items()}


def _screenshot(browser: str, url: str, width: int, height: int) -> bytes:
    with TemporaryDirectory() as folder:
        target = Path(folder) / "page.png"
        command = [browser, "--headless=new", "--disable-gpu", "--hide-scrollbars", "--timeout=4000"]
        command += [f"--user-data-dir={folder}", f"--window-size={width},{height}", f"--screenshot={target}", url]
        if os.geteuid() == 0:  # its sandbox refuses root
            command.insert(1, "--no-sandbox")
        subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=120, check=True)
        return target.read_bytes()
