"""Whether pictures can be taken here; what needs them is left out otherwise."""

from functools import cache

from lw_torchrl.suites.cameras import Cameras


@cache
def why_no_pictures():
    """What is missing; nothing where pictures can be taken."""
    try:
        Cameras().close()
    except ImportError as error:
        return str(error)
    return ""
