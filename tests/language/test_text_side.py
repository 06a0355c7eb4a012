"""Tasks, queries and plans need no torch."""

import subprocess
import sys

import pytest

PROGRAMS = {
    "canonical plans": """
import lw_torchrl.language.plans, lw_torchrl.language.canonical
plans = lw_torchrl.canonical_plans(lw_torchrl.load_plans("MT50"), fallback=True)
assert lw_torchrl.Plans.from_json(plans.to_json()) == plans
""",
    "queries": """
import lw_torchrl.language.nearest
assert lw_torchrl.parse_query("the gripper above the puck", "push")
assert lw_torchrl.language.nearest.nearest_query("gripper is over the puck", "push")
""",
    "answers": """
import numpy as np
text = lw_torchrl.encode_plan(lw_torchrl.load_plans("MT10")["push"], "chain_py")
assert lw_torchrl.decode_plan(text, "push", "chain_py").all_scripted
assert lw_torchrl.TASKS["push"].positions(np.arange(39.0))["puck"].tolist() == [4.0, 5.0, 6.0]
""",
}


@pytest.mark.parametrize("program", PROGRAMS.values(), ids=PROGRAMS)
def test_plans_and_queries_do_without_torch(program):
    heavy = "import sys; print(sorted({'torch', 'tensordict', 'torchrl', 'numba', 'mujoco'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", f"import lw_torchrl{program}{heavy}"], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
