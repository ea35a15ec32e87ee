"""Pages in a browser: what is wider than its window at 1200 and at 420 pixels, or complained of, or fetched.

A table alone may be wider than its box, in which it is moved sideways.
"""

import json
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "docs" / "_site"))
from chromium import Browser, program

WIDTHS = (1200, 420)
INSIDE = """[...document.querySelectorAll('body *')].filter(part => part.scrollWidth > part.clientWidth + 1
    && !part.matches('.scroll') && /auto|scroll|hidden/.test(getComputedStyle(part).overflowX)).map(part =>
    `${part.tagName} ${part.scrollWidth} > ${part.clientWidth}: ${part.textContent.trim().slice(0, 60)}`)"""


def wrong(browser: Browser, page: str) -> list[str]:
    """What is wrong with a page, a file or what a server on this machine tells."""
    served = page.startswith("http://127.0.0.1:")
    server = ("/".join([*page.split("/")[:3], ""]),) if served else ()
    local = ("file:", "data:", *server)
    results = []
    for width in WIDTHS:
        seen = browser.open(page if served else Path(page).resolve().as_uri(), width)
        inside = browser.call("Runtime.evaluate", expression=INSIDE, returnByValue=True)["result"]["value"]
        results += [f"at {width}: {item}" for item in [*inside, *seen.errors]]
        results += [f"at {width}: the page is {seen.width} wide"] if seen.width > width else []
        results += [f"fetches {address}" for address in seen.requests if not address.startswith(local)]
    return results


class Widths:
    """Measures pages in a process of its own, which forks without the threads of this one; without a browser, none."""

    def __init__(self, text: Path) -> None:
        self.text = text  # where a page that is no file is put
        self.process: subprocess.Popen[str] | None = None

    @staticmethod
    def there() -> bool:
        """Whether there is a browser."""
        return program() is not None

    def __call__(self, page: Path | str) -> None:
        """Fail if something on a page, a file, its text or an address, is wider than its window."""
        if not self.there():
            return
        if isinstance(page, str) and not page.startswith("http:"):
            self.text.write_text(page, encoding="utf-8")
            page = self.text
        if self.process is None:
            command = [sys.executable, __file__]
            self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(f"{page}\n")
        self.process.stdin.flush()
        content = json.loads(self.process.stdout.readline())
        assert not content, content

    def close(self) -> None:
        """End the browser."""
        if self.process is not None:
            self.process.communicate()


if __name__ == "__main__":
    with Browser() as browser:
        for line in sys.stdin:
            print(json.dumps(wrong(browser, line.strip())), flush=True)
