"""Run the blocks of a page of the documentation with more runs than its own, and print what they print.

Run: python benchmarks/long_run.py PAGE NAME=NUMBER ..., such as `delays runs=4096`. Each name is a number that the page
sets once, at the beginning of a line; the blocks run in the page's order, and their assertions must hold as they stand.
"""

import re
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


def with_numbers(blocks: str, numbers: dict[str, str]) -> str:
    """The blocks with other numbers in the place of those that they set.

    Raises:
        ValueError: a name that the page does not set once.
    """
    for name, number in numbers.items():
        blocks, count = re.subn(rf"^{name} = \d+$", f"{name} = {number}", blocks, flags=re.MULTILINE)
        if count != 1:
            raise ValueError(f"{name}: expected a number that the page sets once, got {count}")
    return blocks


if __name__ == "__main__":
    page, *changes = sys.argv[1:]
    blocks = "\n".join(BLOCK.findall((DOCS / f"{page}.md").read_text()))
    exec(compile(with_numbers(blocks, dict(change.split("=") for change in changes)), page, "exec"), {})
