"""Print a script that completes commands and options with the Tab key."""

from typing import Any, Literal

import click

from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, Tool, argument


class Completion(Tool):
    """Print a script that completes commands, options, choices and file names with Tab.

    \b
    bash  limber completion bash > ~/.local/share/bash-completion/completions/limber
    zsh   limber completion zsh > ~/.zfunc/_limber     # with ~/.zfunc in $fpath
    fish  limber completion fish > ~/.config/fish/completions/limber.fish

    It takes effect in the next shell. The script queries `limber` itself, so that it knows the
    commands and options of the installed version, including those of other packages.
    """

    about = About("completion", prints=True)

    shell: Literal["bash", "zsh", "fish"] = argument("The shell.")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from click.shell_completion import get_completion_class

        from limber.cli.main import main

        kind = get_completion_class(self.shell)
        assert kind is not None, self.shell
        click.echo(kind(main, {}, "limber", "_LIMBER_COMPLETE").source())
        return {}
