"""``python -m limber``: the command ``limber``, for where scripts are not on the PATH."""

import sys

from limber.cli.main import call

if __name__ == "__main__":
    sys.exit(call())
