"""Test the plans behind runs without a map: the scene as it is, in its own coordinates, and none of another one."""

import json

import numpy as np

from tests.helpers.box_rooms import two_rooms
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.eval.episodes.manifest import MANIFEST
from vssm_gym.eval.report.scene_plans import scene_plans


def sweep(folder, content):
    """Return the rows of a sweep of one scene."""
    file = str(folder / "rooms.json")
    save_scene(two_rooms(), folder / "rooms.json")
    (folder / MANIFEST).write_text(json.dumps({"config": {"scenes": [file]}}))
    return [{"scene": "rooms", "scene_hash": content}]


def test_walls_are_where_they_stand(tmp_path):
    plan = scene_plans(tmp_path, sweep(tmp_path, two_rooms().content_hash()), ())["rooms"]
    left, right, bottom, top = plan.extent
    height, width, _ = plan.image.shape
    colour = lambda x, y: plan.image[
        int((y - bottom) / (top - bottom) * height), int((x - left) / (right - left) * width)
    ]
    boxes = [box for box in two_rooms().boxes() if box.kind == "wall"]
    walls = np.array([colour(*box.center[:2]) for box in boxes])
    assert (walls.max(axis=1) < 0.4).mean() > 0.8  # one lies above the door
    assert colour(0.6, 1.0).min() > 0.5  # floor


def test_a_scene_that_has_a_map_or_has_changed_is_not_drawn(tmp_path):
    rows = sweep(tmp_path, two_rooms().content_hash())
    assert scene_plans(tmp_path, rows, {"rooms"}) == {}
    assert scene_plans(tmp_path, sweep(tmp_path, "0" * 16), ()) == {}
    rows = sweep(tmp_path, two_rooms().content_hash())
    (tmp_path / "rooms.json").unlink()
    assert scene_plans(tmp_path, rows, ()) == {}
