"""Print a script that completes commands and options with the Tab key."""

import click


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def command(shell: str) -> None:
    """Print a script that completes commands, options, choices and file names with Tab.

    \b
    bash  limber completion bash > ~/.local/share/bash-completion/completions/limber
    zsh   limber completion zsh > ~/.zfunc/_limber     # with ~/.zfunc in $fpath
    fish  limber completion fish > ~/.config/fish/completions/limber.fish

    It takes effect in the next shell. The script queries `limber` itself, so that it knows the
    commands and options of the installed version, including those of other packages.
    """
    from click.shell_completion import get_completion_class

    from limber.cli.main import main

    kind = get_completion_class(shell)
    assert kind is not None, shell
    click.echo(kind(main, {}, "limber", "_LIMBER_COMPLETE").source())
