"""The command line, ``lw-torchrl``: one file for each group of commands."""
