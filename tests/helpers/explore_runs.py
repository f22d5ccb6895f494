"""Make rows of explorers' runs, as a sweep writes them: coverage grows in proportion to the path."""

import numpy as np

STEPS, STEP, DT = 500, 0.16, 0.2  # a budget of 80 m and 100 s


def run(agent, metres_90, *, ends=None, stopped=True, scene="oak", task=0, collided=False, navigation=None, **more):
    """Make the row of a straight run at 0.4 m/s: 90 % after ``metres_90`` m, its end after ``ends`` m (at 100 %).

    Entropy falls with coverage by 1 Mnat; completeness is 0.8 of coverage. A run that ends before 90 % has failed.
    """
    ends = metres_90 / 0.9 if ends is None else ends
    metres = np.linspace(0.0, ends, 25).round(3)
    coverage = np.minimum(0.9 * metres / metres_90, 1.0)

    def reached(level):
        metres = metres_90 * level / 90.0
        return round(metres, 4) if metres <= ends + 1e-9 else None

    driven = {level: reached(level) for level in (50, 90, 95, 99)}
    success = bool(coverage[-1] >= 0.9 - 1e-9)
    return {
        "env": "vssm_gym/Explore-v0",
        "scene": scene,
        "scene_hash": f"hash of {scene}",
        "robot": "holonomic",
        "noise": "low",
        "sensor_noise": "none",
        "renderer": "raycast",
        "physics": "mujoco",
        "end_on": "stop",
        "task": task,
        "seed": 0,
        "agent": agent,
        "version": "0.1.0",
        "success": success,
        **{f"metres_{level}": metres for level, metres in driven.items()},
        **{f"seconds_{level}": None if metres is None else round(metres / 0.4, 3) for level, metres in driven.items()},
        "curve": {
            "metres": metres.tolist(),
            "seconds": (metres / 0.4).round(3).tolist(),
            "coverage": coverage.round(4).tolist(),
            "entropy": (-1e6 * coverage).round(1).tolist(),
            "completeness": (0.8 * coverage).round(4).tolist(),
        },
        "coverage": float(coverage[-1]),
        "entropy": float(-1e6 * coverage[-1]),
        "completeness": float(0.8 * coverage[-1]),
        "accuracy": 0.012,
        "accurate_5cm": 0.97,
        "completion": 0.08,
        "complete_5cm": 0.7,
        "path_length": float(ends),
        "seconds": float(ends / 0.4),
        "steps": round(ends / 0.4 / DT),
        "stopped": stopped,
        "collisions": int(collided),
        "collided": collided,
        "location_error_mean": 0.0,
        "location_error_max": 0.0,
        "location_error_final": 0.0,
        "nees": 0.5,
        "in_95": 1.0,
        "budget": {"steps": STEPS, "seconds": STEPS * DT, "metres": STEPS * STEP},
        "failure": None if success else f"time out: {100 * coverage[-1]:.0f} % covered after 500 steps",
        "status": "finished: nothing left to gain" if stopped else "driving",
        "latency": {"total": {"p50": 0.02, "p95": 0.2}},
        **(
            {}
            if navigation is None
            else {"navigation": {"tasks": 2, "success": navigation, "spl": navigation, "failures": []}}
        ),
        "trace": {
            "true": [[0.1 * k, 0.2 * task] for k in range(20)],
            "estimate": None,
            "contacts": [[0.5, 0.2 * task]] if collided else [],
            "reached": {"50": [0.8, 0.2 * task], "90": [1.5, 0.2 * task]} if success else {},
        },
        **more,
    }
