"""`heliograph completion`: script with which a shell completes commands, options and files."""

from typing import Annotated, Literal

from cyclopts import Parameter

from heliograph.cli.app import app


def completion(
    shell: Annotated[Literal["bash", "zsh", "fish", "powershell"], Parameter(help="Which shell.")], /
) -> None:
    """Print a shell's completion script; in bash: eval "$(heliograph completion bash)"."""
    print(app.generate_completion(prog_name="heliograph", shell=shell))
