"""Contacts of the Warp backend against MuJoCo's, one by one: how many, in which order, where, how deep."""

# mypy: ignore-errors
# the kernel: Warp reads it with types of its own

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import warp as wp

from dropo_torch.simulators.warp.collide import capsule_box_codes, capsule_box_contact, vec7
from dropo_torch.simulators.warp.start import start_warp
from dropo_torch.simulators.warp.types import Mats, Vec3s, f64, vec3

MARGIN = 0.02
RADIUS, HALF = 0.05, 0.2
SIZE = (0.15, 0.1, 0.2)
CAPSULE_AND_BOX = f"""<mujoco><worldbody>
<body><freejoint/><geom type="capsule" size="{RADIUS} {HALF}" margin="{MARGIN}"/></body>
<body><freejoint/><geom type="box" size="{SIZE[0]} {SIZE[1]} {SIZE[2]}"/></body></worldbody></mujoco>"""


@wp.kernel(enable_backward=False)
def capsule_box_kernel(c1: Vec3s, r1: Mats, c2: Vec3s, r2: Mats, size: vec3, found: wp.array2d(dtype=vec7)):
    """Contacts of a capsule and a box; infinitely far where there is none."""
    i = wp.tid()
    a1 = vec3(r1[i][0, 2], r1[i][1, 2], r1[i][2, 2]) * f64(HALF)
    back = wp.transpose(r2[i])
    limit = f64(MARGIN) + f64(2.0) * (f64(RADIUS) + f64(HALF) + size[0] + size[1] + size[2])
    first, second = capsule_box_codes(back * (c1[i] - c2[i]), back * a1, size, limit)
    for k in range(2):
        code = wp.where(k == 0, first, second)
        x = vec7()
        x[0] = f64(1.0)
        if code >= 0:
            x = capsule_box_contact(c1[i], a1, f64(RADIUS), c2[i], r2[i], size, code)
        found[i, k] = x


def poses(rng: np.random.Generator, count: int, aligned: bool) -> np.ndarray:
    """Positions of two free bodies that are near each other, at random or by quarter turns and a little more."""
    qpos = np.zeros((count, 14))
    qpos[:, :3] = rng.uniform(-0.3, 0.3, (count, 3))
    turned = rng.normal(size=(count, 2, 4))
    if aligned:
        quarter = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [1, 0, 1, 0], [1, 0, 0, 1], [0, 1, 0, 0.0]])
        turned = quarter[rng.integers(0, 5, (count, 2))] + rng.normal(size=(count, 2, 4)) * 1e-4
    qpos[:, 3:7], qpos[:, 10:14] = turned[:, 0], turned[:, 1]
    qpos[:, 7:10] = rng.uniform(-0.05, 0.05, (count, 3))
    return qpos


@pytest.mark.parametrize("aligned", [False, True])
def test_capsule_and_box_touch_where_mujoco_says(aligned: bool) -> None:
    model = mujoco.MjModel.from_xml_string(CAPSULE_AND_BOX)
    data = mujoco.MjData(model)
    qpos = poses(np.random.default_rng(0), 4000, aligned)
    where = []
    expected = []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        where.append((data.geom_xpos.copy(), data.geom_xmat.copy().reshape(2, 3, 3)))
        expected.append([np.r_[c.dist, c.pos, c.frame[:3]] for c in data.contact])
    start_warp()
    arrays = [np.array([w[k][g] for w in where]) for g in (0, 1) for k in (0, 1)]
    c1, r1, c2, r2 = (
        wp.array(a, dtype=wp.vec3d if a.ndim == 2 else wp.mat33d, device="cpu") for a in arrays
    )  # fmt: skip
    found = wp.zeros((len(qpos), 2), dtype=vec7, device="cpu")
    wp.launch(capsule_box_kernel, len(qpos), inputs=[c1, r1, c2, r2, vec3(*SIZE), found], device="cpu")
    numbers = [0, 0, 0]
    for i, (mine, theirs) in enumerate(zip(found.numpy(), expected, strict=True)):
        mine = mine[mine[:, 0] < MARGIN]
        assert len(mine) == len(theirs), i
        numbers[len(mine)] += 1
        if theirs:
            np.testing.assert_allclose(mine, theirs, atol=1e-9 if aligned else 1e-11, rtol=0, err_msg=str(i))
    assert min(numbers) > 200
