"""``python -m limber``: the command ``limber``, for where scripts are not on the PATH."""

from limber.cli.main import run

if __name__ == "__main__":
    run()
