"""The search for coplanar faces against a search of all pairs."""

import numpy as np
import pytest

from mi_radiosity.scene.overlap import Overlaps, _triangles_meet


@pytest.mark.parametrize("seed", range(12))
def test_finds_every_pair(seed):
    """Triangles of sizes over three decades in three tilted planes, off the origin, as float32 has them."""
    random, n = np.random.default_rng(seed), 120
    size, height = 10 ** random.uniform(-3, 0, n), random.choice([-0.5, 0, 0.3], n)
    flat = random.uniform(-1, 1, (n, 1, 2)) + size[:, None, None] * random.normal(size=(n, 3, 2))
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    corners = (
        (np.concatenate([flat, np.broadcast_to(height[:, None, None], (n, 3, 1))], axis=2) @ turn.T + seed)
        .astype(np.float32)
        .astype(float)
    )
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area, every, none = np.linalg.norm(normal, axis=1) / 2, np.ones((n, 2), dtype=bool), np.zeros((n, 2))
    normal /= 2 * area[:, None]
    tolerance = 2.0**-18 * np.abs(corners).max()
    overlaps = Overlaps(corners, normal, area, every[:, 0], np.arange(n), every, none, none, tolerance)
    f, g = np.triu_indices(n, 1)
    f, g = f[height[f] == height[g]], g[height[f] == height[g]]
    meet = _triangles_meet(flat[f], flat[g], tolerance)
    found = {(a, b) for a, b in zip(*overlaps._pairs(normal, area, every[:, 0])) if a < b}
    assert found == set(zip(f[meet], g[meet])) and len(found) > 20
