"""What track simulations look at: points in the furnished room, on one wall, or on the floor.

World as in `rigs.py`: z up, metres; every scene has its points where the room has them.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from graphs.frames import FloatArray
from sfm_calib.simulate.room import ROOM_SIZE_M

SceneName = Literal["room", "wall", "plane", "ground"]

WALL_DEPTH_M = 0.55  # how far points stand out from the room's walls
# How far points stand out from a single surface. Seen from 1.3 m, 5 cm is a rough stone wall; from
# 1.8 m, 3 cm is what crops of 1.7 m are to a drone at 100 m.
WALL_RELIEF_M, GROUND_RELIEF_M = 0.05, 0.03
MARGIN_M = 0.5  # of the wall beyond the room's: views of the whole of it have full corners


def scene_points(scene: SceneName, count: int, rng: np.random.Generator) -> FloatArray:
    """Points (count, 3) of a scene in metres.

    room: within WALL_DEPTH_M of a wall, the floor or the ceiling; wall: the wall at +y alone, with
    WALL_RELIEF_M of relief; plane: the same, exactly flat; ground: the floor alone, with
    GROUND_RELIEF_M of relief.
    """
    if scene == "room":
        return _room(count, rng)
    across, up, out = rng.uniform(0, 1, (3, count))
    x = ROOM_SIZE_M[0] * (across - 0.5)
    if scene == "ground":
        return np.stack([x, ROOM_SIZE_M[1] * (up - 0.5), GROUND_RELIEF_M * out], axis=1)
    relief_m = WALL_RELIEF_M if scene == "wall" else 0.0
    z = (ROOM_SIZE_M[2] + 2 * MARGIN_M) * up - MARGIN_M
    return np.stack([x, ROOM_SIZE_M[1] / 2 - relief_m * out, z], axis=1)


def _room(count: int, rng: np.random.Generator) -> FloatArray:
    size = np.array(ROOM_SIZE_M)
    kept = np.empty((0, 3))
    while len(kept) < count:
        inside = rng.uniform(0, 1, (2 * count, 3)) * size
        wall = np.minimum(inside, size - inside).min(axis=1)
        kept = np.concatenate([kept, inside[wall < WALL_DEPTH_M]])
    return kept[:count] - [size[0] / 2, size[1] / 2, 0.0]
