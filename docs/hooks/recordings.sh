#!/bin/sh
# Make the screenshots of recordings in docs/, with what each shows. Needs Vulkan; takes a few minutes.
#     sh docs/hooks/recordings.sh
set -eu
docs=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
cd "$work"
: "${LW:=lw-torchrl}" "${PYTHON:=python}"

picture() { # RECORDING NAME [OPTIONS of view]
    recording=$1 name=$2
    shift 2
    $LW view $recording --screenshot "$name.png" --window-size 1100x700 "$@"
    $PYTHON -c 'import sys; from PIL import Image
Image.open(sys.argv[1]).convert("RGB").quantize(256).save(sys.argv[2], optimize=True)' "$name.png" "$docs/$name.png"
}

$LW record pick-place --policy scripted --out success.rrd
picture success.rrd rerun-success

# A plan that closes the gripper only after the puck has left the table, which never happens.
mkdir mine
cat > mine/pick-place.plan <<'PLAN'
# pick-place: Pick up the puck and hold it at the target location in the air.
def pick_place(robot):
    if check("the robot's gripper is not above the puck and the robot's gripper is not near the puck"):
        robot.place("the gripper above the puck")
    if check("the robot's gripper is above the puck and the robot's gripper is not near the puck and the puck is touching the table"):
        robot.lower("the gripper around the puck")
    if check("the robot's gripper is near the puck and the puck is not touching the table"):
        robot.close("the gripper around the puck")
    if check("the robot's gripper is vertically aligned with the puck and the puck is not touching the table"):
        robot.move("the puck to the target location")
PLAN
$LW record pick-place --policy scripted --plans mine/pick-place.plan --attribute --reference MT50 --out plan.rrd
picture plan.rrd rerun-plan

$LW record pick-place --policy few-shot-mt50 --episodes 2 --max-steps 150 --noise 0.3 --attribute --out gripper.rrd
picture gripper.rrd rerun-gripper

# An evaluator that inverts the second condition.
$PYTHON - <<'CODE'
import torch
from torchrl.envs import Compose, Transform, TransformedEnv

import lw_torchrl as lw

plans = lw.Plans([lw.load_plans("MT10")["drawer-open"]])
actor = lw.ScriptedSkillActor(plans)


def invert(tensordict):
    return tensordict.set("qaf", tensordict["qaf"] ^ torch.tensor([False, True, False]))


class Invert(Transform):
    def _call(self, next_tensordict):
        return invert(next_tensordict)

    def _reset(self, tensordict, tensordict_reset):
        return invert(tensordict_reset)


base = lw.LanguageWorldEnv("drawer-open", seed=1_000, max_steps=200)
rollout = TransformedEnv(base, Compose(lw.QAFTransform(plans), Invert())).rollout(200, actor)[0]
[failure] = lw.attribute_failures(
    [rollout], plans, actor=actor, evaluator=invert, seed=1_000, noise_scale=0.0, max_steps=200
)
with lw.RerunLogger("query.rrd") as logger:
    lw.log_rollout(logger, rollout, plans, seed=1_000, policy="inverted condition", failure=failure)
CODE
picture query.rrd rerun-query

$LW train-evaluator drawer-open --cameras corner corner3 --episodes 4 --steps 200 --out eyes
$LW record drawer-open --policy scripted --evaluator eyes/evaluator.safetensors --max-steps 150 --attribute --out eyes.rrd
picture eyes.rrd rerun-pictures

$LW record pick-place push door-open drawer-open peg-insert-side window-open assembly shelf-place \
    --policy few-shot-mt50 --episodes 0 1 2 --max-steps 150 --noise 0.3 --attribute --out many.rrd
picture many.rrd rerun-overview

$LW record drawer-open --policy noisy-30 --compare scripted --max-steps 200 --out compare.rrd
picture compare.rrd rerun-compare

for number in 1 5; do
    $PYTHON "$docs/../examples/rerun_training.py" --demonstrations $number --rollouts 2 --out runs/$number/training.rrd
done
picture "runs/1 runs/5" rerun-runs --episode metrics

$PYTHON "$docs/../examples/your_robot/your_robot.py"
picture runs/arm/arm.rrd your-robot
