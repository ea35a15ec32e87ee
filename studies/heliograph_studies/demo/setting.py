"""Which drive, and how often its relays are drawn."""

from dataclasses import dataclass
from pathlib import Path

from heliograph.numerics.check import check_count, check_seed
from heliograph_studies.demo.recording import find_recording


@dataclass(frozen=True)
class Setting:
    """recording: plaza1 or plaza2; `seeds` draws of the relays, the first with `seed`, which is shown in full."""

    recording: str = "plaza2"
    seeds: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("seeds", self.seeds)
        check_seed(f"last of {self.seeds} seeds", check_seed("seed", self.seed) + self.seeds - 1)
        self.files()

    def files(self) -> list[Path]:
        """What is read."""
        return [find_recording(self.recording)]
