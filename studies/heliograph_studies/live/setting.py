"""How often the service is killed, and how many messages its speed is measured with."""

from dataclasses import dataclass

from heliograph.numerics.check import check_count, check_seed


@dataclass(frozen=True)
class Setting:
    """kills: with -9, at random moments; messages: of a hundred mowers, for the speed."""

    kills: int = 3
    messages: int = 20_000
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("kills", self.kills)
        check_count("messages", self.messages, 2000)
        check_seed("seed", self.seed)
