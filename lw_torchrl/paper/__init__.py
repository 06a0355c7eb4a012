"""The paper's experiments: recipes, the runs they make, how each trains, where they run; and the demo."""

import lw_torchrl._torchrl  # noqa: F401
