"""``python -m lw_torchrl``: the command line."""

from lw_torchrl.cli.main import main

if __name__ == "__main__":
    main()
