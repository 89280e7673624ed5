"""A user's own task: a pole on a cart, kept upright."""

from __future__ import annotations

import mujoco
import torch

from dropo_torch.rl import Task

CART_POLE = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" damping="0.1"/>
      <geom type="box" size=".1 .05 .05" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 .6" size=".02" mass=".1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide" gear="10" ctrlrange="-1 1"/></actuator>
</mujoco>"""


class CartPole(Task):
    name = "cartpole"
    frame_skip = 2
    max_episode_steps = 20
    num_observations = 4

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(CART_POLE)

    def initial_states(self, count: int, generator: torch.Generator) -> torch.Tensor:
        return 0.1 * torch.rand(count, 4, generator=generator, dtype=torch.float64) - 0.05

    def observe(self, states: torch.Tensor) -> torch.Tensor:
        return states

    def reward(self, states: torch.Tensor, actions: torch.Tensor, next_states: torch.Tensor) -> torch.Tensor:
        return torch.cos(next_states[:, 1]) - 0.01 * actions[:, 0] ** 2

    def terminated(self, next_states: torch.Tensor) -> torch.Tensor:
        return next_states[:, 1].abs() > 0.5
