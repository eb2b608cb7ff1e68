"""An exported policy on the robot, with onnxruntime and numpy alone: python run_exported_policy.py policy.onnx"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import onnxruntime


class ExportedPolicy:
    def __init__(self, path):
        self.card = json.loads(Path(path).with_suffix(".json").read_text())
        self.session = onnxruntime.InferenceSession(path)
        self.reset()

    def reset(self):  # at the start of every episode: nothing is remembered
        parts = self.card["memory"]
        self.memory = {part["input"]: np.full((1, *part["shape"]), part["initial"], part["dtype"]) for part in parts}

    def act(self, observation):  # as often as the card's decision_period_s says
        observation = {name: np.asarray(value)[None] for name, value in observation.items()}
        values = self.session.run(self.card["outputs"], {**observation, **self.memory})
        self.outputs = dict(zip(self.card["outputs"], values, strict=True))
        self.memory = {part["input"]: self.outputs[part["output"]] for part in self.card["memory"]}
        return self.outputs["action"][0]


if __name__ == "__main__":
    policy = ExportedPolicy(sys.argv[1])
    for _ in range(5):
        observation = {
            part["name"]: np.zeros(part["shape"], part["dtype"]) for part in policy.card["observation"]
        }  # your sensors
        print(policy.act(observation))
        time.sleep(policy.card["decision_period_s"] or 0.0)
