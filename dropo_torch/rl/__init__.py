"""Policies over the distribution: batched environments whose episodes each have parameters of their own."""

from dropo_torch.support.extras import extra

with extra("rl", "a policy"):
    from dropo_torch.rl.env import RandomizedEnv
    from dropo_torch.rl.sampling import DistributionSource, ParameterSource, PointSource, UniformSource, load_source
    from dropo_torch.rl.stepper import BatchStepper, MujocoStepper
    from dropo_torch.rl.task import Task, load_task
    from dropo_torch.rl.vector import RandomizedVectorEnv

__all__ = [
    "BatchStepper", "DistributionSource", "MujocoStepper", "ParameterSource", "PointSource", "RandomizedEnv",
    "RandomizedVectorEnv", "Task", "UniformSource", "load_source", "load_task",
]  # fmt: skip
