"""``python -m dropo_torch``: the command line."""

import sys

from dropo_torch.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())
