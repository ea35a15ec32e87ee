"""What README says of a published method: its row of the table."""

from pathlib import Path

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")


def said_of(method: str) -> tuple[str, str]:
    """What was published, and what is found here."""
    (row,) = (line for line in README.splitlines() if line.startswith(f"| `{method}`: "))
    _, published, here = row.strip("| ").split(" | ")
    return published, here
