"""A study that is a function yet."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


class Old:
    """Takes values as text and calls the function."""

    def __init__(self, function: Callable[..., None]) -> None:
        self.function = function

    def settings(self, values: Mapping[str, str]) -> Any:
        """Numbers where the text is one."""
        return {name: int(value) if value.isdigit() else value for name, value in values.items()}

    def run(self, setting: Any, out: Path) -> None:
        """Call it."""
        self.function(out, **setting)

    def __call__(self, *arguments: Any, **named: Any) -> None:
        """The function itself."""
        self.function(*arguments, **named)
