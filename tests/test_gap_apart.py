"""Limbs that nothing couples are differenced together, and only those; large searches simulate with Warp."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.effects import Placed, find_effect
from dropo_torch.effects.engine import Variant
from dropo_torch.gap import Scene, prepare, scene
from dropo_torch.gap.apart import Limbs
from dropo_torch.gap.refit import beside, limits_of

ARM = """<body name="{0}_upper" pos="{1} 0 1">
  <joint name="{0}_shoulder" axis="0 1 0" damping=".05"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/>
  <body name="{0}_fore" pos="0 0 -.3">
    <joint name="{0}_elbow" axis="0 1 0" damping=".03"/><geom type="capsule" fromto="0 0 0 0 0 -.25" size=".02"/>
  </body>
</body>"""
TWO = (
    '<mujoco><option timestep=".002"/><default><geom contype="0" conaffinity="0"/></default><worldbody>'
    + ARM.format("left", 0) + ARM.format("right", 1)
    + "</worldbody>{}<actuator>"
    + "".join(f'<motor joint="{s}_{j}"/>' for s in ("left", "right") for j in ("shoulder", "elbow"))
    + "</actuator></mujoco>"
)  # fmt: skip
COUPLED = '<equality><joint joint1="left_elbow" joint2="right_elbow"/></equality>'


def scene_of(folder: Path, between: str = "") -> Scene:
    """Two arms that swing, with some noise."""
    model, rng = mujoco.MjModel.from_xml_string(TWO.format(between)), np.random.default_rng(0)
    data, rows, commands = mujoco.MjData(model), [], []
    for step in range(240):
        data.ctrl[:] = 0.4 * np.sin(0.2 * step + np.arange(4))
        rows.append(np.concatenate([data.qpos, data.qvel]))
        commands.append(data.ctrl.copy())
        mujoco.mj_step(model, data, 5)
    shown = np.array(rows) + 1e-3 * rng.standard_normal((240, 8))
    np.savez(folder / "log.npz", observations=shown, actions=np.array(commands), terminals=np.arange(240) == 239)
    (folder / "arms.xml").write_text(TWO.format(between))
    data = {"path": "log.npz", "dt": 0.01}
    config = dropo.make_config({"model": "arms.xml", "data": data, "frame_skip": 5}, base=folder)
    return prepare(dropo.make_problem(config, general=True))


@pytest.fixture(scope="module")
def arms(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return scene_of(tmp_path_factory.mktemp("arms"))


def placed(names: Sequence[str], joints: Sequence[str]) -> list[Placed]:
    return [Placed(find_effect(n), j, (0.02,)) for n in names for j in joints]


def test_changes_of_limbs_together_are_those_of_each_alone(arms: Scene) -> None:
    evidence, joints = arms.evidence.few(6), ["left_shoulder", "left_elbow", "right_shoulder", "right_elbow"]
    hypothesis = arms.begin.with_effects(placed(["armature", "joint_friction"], joints))
    moved, _ = beside(hypothesis, limits_of(hypothesis, evidence.twin), np.arange(8), 1e-3)
    variants, own = [h.variant for h in moved], hypothesis.variant
    at = evidence.residuals([own])[0][0]
    before = evidence.twin.simulated_transitions
    found = evidence.beside(own, at, variants)
    simulated = evidence.twin.simulated_transitions - before
    np.testing.assert_allclose(found, evidence.residuals(variants)[0], rtol=0, atol=1e-9)
    assert simulated == 4 * len(evidence.windows) * evidence.windows.length  # and not 8
    starts = np.eye(evidence.chart.size)[:, None]
    one, other = evidence.beside(own, at, [own] * 8, starts), evidence.residuals([own] * 8, starts)[0]
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


def test_what_acts_on_all_limbs_is_simulated_alone(arms: Scene) -> None:
    evidence, tilt = arms.evidence.few(3), Placed(find_effect("gravity_tilt"), None, (0.01, 0.02))
    own = arms.begin.variant
    others = [Variant(own.declared, (p,)) for p in (tilt, *placed(["armature"], ["left_elbow", "right_elbow"]))]
    at = evidence.residuals([own])[0][0]
    np.testing.assert_allclose(evidence.beside(own, at, others), evidence.residuals(others)[0], rtol=0, atol=1e-9)


def test_where_one_limb_diverges_the_others_are_simulated_alone(arms: Scene) -> None:
    limbs, at = Limbs.of(arms.setting, arms.evidence.chart, ()), np.zeros((2, 8))
    assert limbs is not None
    variants = [Variant((), (p,)) for p in placed(["armature"], ["left_elbow", "right_elbow"])]
    calls = []

    def simulate(some: Sequence[Variant], moved: np.ndarray | None) -> np.ndarray:
        calls.append(len(some))
        return np.full((len(some), 2, 8), np.nan if len(calls) == 1 else 1.0)

    found = limbs.residuals(Variant((), ()), at, variants, None, simulate)
    assert calls == [1, 2]
    np.testing.assert_array_equal(found, np.ones((2, 2, 8)))


def test_limbs_that_are_coupled_are_one(tmp_path: Path) -> None:
    coupled = scene_of(tmp_path, COUPLED)
    assert Limbs.of(coupled.setting, coupled.evidence.chart, ()) is None


def test_a_large_search_simulates_with_warp_and_sees_the_same(
    monkeypatch: pytest.MonkeyPatch, arms: Scene, tmp_path: Path
) -> None:
    assert not arms.twin.warp
    monkeypatch.setattr(scene, "LARGE", 0)
    fast = scene_of(tmp_path)
    assert fast.twin.warp
    one, other = (s.evidence.residuals([s.begin.variant])[0] for s in (arms, fast))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-8)
