"""``python -m lw_torchrl``: the command line."""

from lw_torchrl.cli import main

if __name__ == "__main__":
    main()
