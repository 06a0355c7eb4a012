"""Whether this machine can render; tests of camera images are skipped otherwise."""

from functools import cache

from lw_torchrl.suites.cameras import Cameras


@cache
def why_no_pictures():
    """Return the reason why this machine cannot render, or ""."""
    try:
        Cameras().close()
    except ImportError as error:
        return str(error)
    return ""
