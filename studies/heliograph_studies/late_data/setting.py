"""What is sent through which network, and how often."""

from dataclasses import dataclass

from heliograph.numerics.check import check_count, check_seed, fail
from heliograph_studies.settings import NO_FILE, File


@dataclass(frozen=True)
class Setting:
    """The network is that of a log at path `trace`, or one with the statistics of a recorded one over `network_s`.

    runs: paths of the moving point, each over `duration` seconds.
    """

    runs: int = 10
    duration: float = 900.0
    network_s: float = 3600.0
    trace: File = NO_FILE
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("runs", self.runs)
        for name in ("duration", "network_s"):
            if not 1.0 <= getattr(self, name) < float("inf"):
                raise fail(name, "seconds, one or more", getattr(self, name))
        check_seed("seed", self.seed)
        object.__setattr__(self, "trace", File(self.trace))  # of a path in any form
