"""What README says, and what docs/studies.md says of a published method: its row of the table."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
STUDIES = (ROOT / "docs" / "studies.md").read_text(encoding="utf-8")


def said_of(method: str) -> tuple[str, str]:
    """What was published, and what is found here."""
    (row,) = (line for line in STUDIES.splitlines() if line.startswith(f"| `{method}`: "))
    _, published, here = row.strip("| ").split(" | ")
    return published, here
