from torchrl.envs import Transform
class RolloutRecorder(Transform):
    pass
