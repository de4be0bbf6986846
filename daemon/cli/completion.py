"""The command ``swath completion``: prints the script by which a shell completes commands and options."""

from __future__ import annotations

from typing import Annotated, Literal

import typer


def command(
    shell: Annotated[Literal["bash", "zsh", "fish"], typer.Argument(metavar="bash|zsh|fish", help="The shell.")],
) -> None:
    """Print the script that makes a shell complete commands and options of `swath`.

    For bash, now and in later shells: `swath completion bash >> ~/.bashrc`.
    """
    from typer._completion_shared import get_completion_script

    from swath.daemon.cli.main import COMPLETE_VARIABLE

    print(get_completion_script(prog_name="swath", complete_var=COMPLETE_VARIABLE, shell=shell))
