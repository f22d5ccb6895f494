"""Compare an agent of your own with others, in an apartment of your own.

    python examples/own_agent.py

``DepthFollower`` turns towards the goal by its commands alone and drives where the depth image is free.
"""

import json
import time
from pathlib import Path

import numpy as np

import vssm_gym as vg


@vg.register_agent
class DepthFollower:
    """Turn to the goal by dead reckoning, and away from what is near."""

    name, robot, task, needs_pose, needs_map = "depth_follower", "holonomic", "pointgoal", False, False

    def reset(self, context: vg.AgentContext, observation: dict, seed: int) -> None:
        """Start where the robot is known to start."""
        self.context, self.pose = context, np.array(context.start_pose, float)
        self.command = np.zeros(3)

    def act(self, observation: dict) -> vg.Decision:
        """Return the next command, and stop where the goal should be."""
        turn, direction, step = self.command
        x, y, heading = self.pose
        self.pose = np.array(
            [x + step * np.cos(heading + direction), y + step * np.sin(heading + direction), heading + turn]
        )
        offset = observation["goal"] - self.pose[:2]
        distance, bearing = np.hypot(*offset), np.arctan2(offset[1], offset[0]) - self.pose[2]
        bearing = (bearing + np.pi) % (2.0 * np.pi) - np.pi
        depth = observation["depth"]
        middle = depth[:, depth.shape[1] // 3 : -(depth.shape[1] // 3)]
        near = bool(((middle > 0.0) & (middle < 0.5)).mean() > 0.05)
        limit = self.context.limits[0]
        arrived = distance < 0.5 * self.context.success_radius
        turn = limit if near else float(np.clip(bearing, -limit, limit))
        step = 0.0 if near or abs(bearing) > 0.5 or arrived else min(0.16, float(distance))
        self.command = np.array([turn, 0.0, step])
        action = np.array([*self.command, float(arrived)], np.float32)
        return vg.Decision(action, self.pose, "arrived" if arrived else "turning away" if near else "driving")


CORNERS = [[0.0, 0.0], [5.0, 0.0], [5.0, 4.0], [0.0, 4.0]]
HOME = {  # docs/scenes.md lists all fields
    "format": 1,
    "name": "studio",
    "rooms": [{"name": "studio", "kind": "living", "polygon": CORNERS, "floor": {"texture": "planks"}}],
    "walls": [
        {"start": a, "end": b, "thickness": 0.1, "height": 2.5}
        for a, b in zip(CORNERS, CORNERS[1:] + CORNERS[:1], strict=True)
    ],
    "ceiling_height": 2.5,
    "doors": [],
    "furniture": [
        {
            "name": "table",
            "category": "table",
            "boxes": [{"center": [2.5, 2.0, 0.4], "size": [1.2, 0.7, 0.8], "material": {"texture": "wood"}}],
        }
    ],
}
CONFIG = "scenes: studio.json\nagents: [oracle, depth_follower, random]\ntasks: 3\nnoise: low\n"

if __name__ == "__main__":  # episodes run in worker processes, which import this file
    Path("studio.json").write_text(json.dumps(HOME))
    Path("compare.yaml").write_text(CONFIG)
    out = Path("compared", time.strftime("%Y%m%d-%H%M%S"))  # a folder a run: rows of other code do not mix
    log = vg.run_sweep(vg.load_config("compare.yaml"), out)
    for row in map(json.loads, log.read_text().splitlines()):
        print(f"{row['agent']:15} task {row['task']}: success {row['success']}, SPL {row['spl']:.2f}")
    print(f"for the report: vssm-gym report {out}")
