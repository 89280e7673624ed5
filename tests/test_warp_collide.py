"""Contacts of the Warp backend against MuJoCo's, one by one: how many, in which order, where, how deep."""

# mypy: ignore-errors
# the kernel: Warp reads it with types of its own

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import warp as wp

from dropo_torch.simulators.warp.boxes import box_contact, box_spots, is_second
from dropo_torch.simulators.warp.collide import (
    are_parallel,
    capsule_box_codes,
    capsule_box_contact,
    cylinder_place,
    overlap_end,
    round_contact,
    sphere_cylinder,
    vec7,
)
from dropo_torch.simulators.warp.start import start_warp
from dropo_torch.simulators.warp.types import Mats, Vec3s, f64, vec3

MARGIN = 0.02
RADIUS, HALF = 0.05, 0.2
SIZE = (0.15, 0.1, 0.2)
#: Half-lengths of the first of two boxes.
FIRST = (0.05, 0.2, 0.1)
PAIR = """<mujoco><worldbody><body><freejoint/><geom type="{}" size="{}" margin="{}"/></body>
<body><freejoint/><geom type="{}" size="{}"/></body></worldbody></mujoco>"""


def pair(one: str, size: tuple[float, ...], two: str, margin: float = MARGIN) -> str:
    """Model of two free geoms; the second has ``SIZE``."""
    width = {"capsule": 2, "cylinder": 2, "box": 3}[two]
    return PAIR.format(one, " ".join(map(str, size)), margin, two, " ".join(map(str, SIZE[:width])))


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


@wp.kernel(enable_backward=False)
def capsules_kernel(c1: Vec3s, r1: Mats, c2: Vec3s, r2: Mats, size: vec3, found: wp.array2d(dtype=vec7)):
    """Contacts of two capsules in MuJoCo's order; infinitely far where there is none."""
    i = wp.tid()
    a1 = vec3(r1[i][0, 2], r1[i][1, 2], r1[i][2, 2]) * f64(HALF)
    a2 = vec3(r2[i][0, 2], r2[i][1, 2], r2[i][2, 2]) * size[1]
    parallel = are_parallel(a1, a2)
    for k in range(2):
        x = vec7()
        x[0] = f64(1.0)
        if parallel:
            x = round_contact(c1[i], a1, f64(RADIUS), c2[i], a2, size[0], overlap_end(c1[i], a1, c2[i], a2, k))
        elif k == 0:
            x = round_contact(c1[i], a1, f64(RADIUS), c2[i], a2, size[0], 0)
        found[i, k] = x


@wp.kernel(enable_backward=False)
def sphere_cylinder_kernel(c1: Vec3s, r1: Mats, c2: Vec3s, r2: Mats, size: vec3, found: wp.array2d(dtype=vec7)):
    """Contact of a sphere and a cylinder."""
    i = wp.tid()
    axis = vec3(r2[i][0, 2], r2[i][1, 2], r2[i][2, 2])
    place = cylinder_place(c1[i] - c2[i], axis, size)
    found[i, 0] = sphere_cylinder(c1[i], f64(RADIUS), c2[i], axis, size, place)


@wp.kernel(enable_backward=False)
def boxes_kernel(c1: Vec3s, r1: Mats, c2: Vec3s, r2: Mats, size: vec3, found: wp.array2d(dtype=vec7)):
    """Contacts of two boxes in MuJoCo's order, each from its code alone; infinitely far where there is none."""
    i = wp.tid()
    first = vec3(f64(0.05), f64(0.2), f64(0.1))  # FIRST
    spots, codes, normal, count = box_spots(c1[i], r1[i], first, c2[i], r2[i], size, f64(MARGIN))
    for k in range(8):
        x = vec7()
        x[0] = f64(1.0)
        if k < count:
            code = codes[k]
            if is_second(code) != 0:
                x = box_contact(c2[i], r2[i], size, c1[i], r1[i], first, code)
            else:
                x = box_contact(c1[i], r1[i], first, c2[i], r2[i], size, code)
            x = vec7(x[0], x[1], x[2], x[3], normal[0], normal[1], normal[2])
            if wp.abs(x[0] - spots[k, 0]) > f64(1e-9):
                x[0] = f64(wp.nan)
        found[i, k] = x


def poses(rng: np.random.Generator, count: int, jitter: float | None) -> np.ndarray:
    """Positions of two free bodies that are near each other, turned at random or by quarter turns and a little more."""
    qpos = np.zeros((count, 14))
    qpos[:, :3] = rng.uniform(-0.3, 0.3, (count, 3))
    turned = rng.normal(size=(count, 2, 4))
    if jitter is not None:
        quarter = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [1, 0, 1, 0], [1, 0, 0, 1], [0, 1, 0, 0.0]])
        turned = quarter[rng.integers(0, 5, (count, 2))] + rng.normal(size=(count, 2, 4)) * jitter
    qpos[:, 3:7], qpos[:, 10:14] = turned[:, 0], turned[:, 1]
    qpos[:, 7:10] = rng.uniform(-0.05, 0.05, (count, 3))
    return qpos


def touching(xml: str, qpos: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Positions and rotations of the two geoms, and MuJoCo's contacts (distance, point, normal), of each state."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    where, expected = [], []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        where.append((data.geom_xpos.copy(), data.geom_xmat.copy().reshape(2, 3, 3)))
        expected.append(np.array([np.r_[c.dist, c.pos, c.frame[:3]] for c in data.contact]).reshape(-1, 7))
    return [np.array([w[k][g] for w in where]) for g in (0, 1) for k in (0, 1)], expected


CASES = {
    "capsule, box": (capsule_box_kernel, pair("capsule", (RADIUS, HALF), "box")),
    "capsules": (capsules_kernel, pair("capsule", (RADIUS, HALF), "capsule")),
    "sphere, cylinder": (sphere_cylinder_kernel, pair("sphere", (RADIUS,), "cylinder")),
    "boxes": (boxes_kernel, pair("box", FIRST, "box")),
}


@pytest.mark.parametrize("jitter", [None, 1e-2, 1e-3, 1e-4, 1e-5, 1e-8, 0.0])
@pytest.mark.parametrize("name", CASES)
def test_geoms_touch_where_mujoco_says(name: str, jitter: float | None) -> None:
    kernel, xml = CASES[name]
    qpos = poses(np.random.default_rng(0), 4000, jitter)
    arrays, expected = touching(xml, qpos)
    start_warp()
    inputs = [wp.array(a, dtype=wp.vec3d if a.ndim == 2 else wp.mat33d, device="cpu") for a in arrays]
    found = wp.full((len(qpos), 8), vec7(1.0, *[0.0] * 6), dtype=vec7, device="cpu")
    wp.launch(kernel, len(qpos), inputs=[*inputs, vec3(*SIZE), found], device="cpu")
    numbers = np.zeros(9, dtype=int)
    for i, (mine, theirs) in enumerate(zip(found.numpy(), expected, strict=True)):
        near = mine[~(mine[:, 0] >= MARGIN)]
        assert len(near) == len(theirs), i
        numbers[len(near)] += 1
        np.testing.assert_allclose(near, theirs, atol=1e-11 if jitter is None else 1e-9, rtol=0, err_msg=str(i))
    assert numbers[0] > 200
    assert numbers[1:].sum() > 200
    if name == "capsule, box":
        assert numbers[2] > 200
    elif name == "capsules":
        assert (numbers[2] > 200) == (jitter is not None and jitter < 1e-4)
    elif name == "boxes":
        assert numbers[4] > 200
        assert jitter is not None or all(numbers[:8] > 10)
