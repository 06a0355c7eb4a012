"""Running the command line within a test."""

import pytest

from lw_torchrl.cli.main import main


def run(capsys, *args):
    """What a command prints."""
    main([str(arg) for arg in args])
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return printed.out


def fails(capsys, *args):
    """The one line with which a command fails."""
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in args])
    assert caught.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("lw-torchrl: error: ")
    assert printed.err.count("\n") == 1, printed.err
    return printed.err
