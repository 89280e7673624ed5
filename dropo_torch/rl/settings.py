"""How a policy is trained: the config's ``train``, one model for each algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import pydantic

from dropo_torch.config import explained
from dropo_torch.errors import InputError
from dropo_torch.support.given import check_keys

Positive = Annotated[float, pydantic.Field(gt=0)]
Share = Annotated[float, pydantic.Field(ge=0, le=1)]
Count = Annotated[int, pydantic.Field(ge=1)]
Widths = Annotated[tuple[Count, ...], pydantic.Field(min_length=1)]


class TrainSettings(pydantic.BaseModel):
    """What both algorithms have.

    Attributes:
        steps: environment steps of the whole run, those of all environments together; never exceeded.
        num_envs: environments that step as one batch.
        hidden: widths of the hidden layers, of the policy's network and of the critic's.
        activation: of the hidden layers.
        learning_rate: of Adam.
        gamma: discount.
        privileged_critic: the critic sees the episode's parameters beside the observation; the policy never does.
        evaluations: how often the policy is evaluated under its distribution; the best is kept.
        episodes: episodes of an evaluation.
        checkpoint_seconds: least time between two checkpoints.
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, strict=False)
    #: Whether actions are a normal's, cut off, or a squashed normal's.
    head: ClassVar[Literal["normal", "tanh"]] = "normal"

    steps: Count = 1_000_000
    num_envs: Count = 1
    hidden: Widths = (64, 64)
    activation: Literal["tanh", "relu", "elu"] = "tanh"
    learning_rate: Positive = 3e-4
    gamma: Share = 0.99
    privileged_critic: bool = True
    evaluations: Count = 20
    episodes: Count = 20
    checkpoint_seconds: Annotated[float, pydantic.Field(ge=0)] = 20.0


class PPOSettings(TrainSettings):
    """How PPO learns (Schulman et al. 2017), with generalized advantages.

    Attributes:
        horizon: steps of every environment between two updates.
        epochs: passes over them, fewer where the policy moves further than ``target_kl``.
        minibatch: steps of a gradient.
        anneal: the learning rate falls linearly to 0.
        lambda_: of the generalized advantages; ``lambda`` in a config.
        clip: of the probability ratio.
        entropy: weight of the policy's entropy.
        target_kl: divergence from the policy that acted, after which no further epoch begins.
        max_grad_norm: longest gradient, of policy and critic each.
        initial_std: the policy's standard deviation at the start, for actions in [-1, 1].
    """

    steps: Count = 4_000_000
    num_envs: Count = 64
    horizon: Count = 64
    epochs: Count = 10
    minibatch: Count = 512
    anneal: bool = True
    lambda_: Share = pydantic.Field(0.95, alias="lambda")
    clip: Positive = 0.2
    entropy: Annotated[float, pydantic.Field(ge=0)] = 0.0
    target_kl: Positive = 0.03
    max_grad_norm: Positive = 1.0
    initial_std: Positive = 0.6


class SACSettings(TrainSettings):
    """How SAC learns (Haarnoja et al. 2018), with two critics and an adapted temperature.

    Attributes:
        warmup: steps of random actions at the start.
        updates_per_step: gradients for each environment step.
        minibatch: steps of a gradient.
        buffer: steps that are remembered; ``steps`` where that is fewer.
        tau: how far the target critics move to the critics after each gradient.
        target_entropy: of the policy; minus the number of actions by default.
    """

    head = "tanh"
    horizon: ClassVar[int] = 1
    initial_std: ClassVar[float] = 1.0
    steps: Count = 700_000
    num_envs: Count = 16
    hidden: Widths = (256, 256)
    activation: Literal["tanh", "relu", "elu"] = "relu"
    warmup: Annotated[int, pydantic.Field(ge=0)] = 10_000
    updates_per_step: Positive = 0.5
    minibatch: Count = 256
    buffer: Count = 1_000_000
    tau: Annotated[float, pydantic.Field(gt=0, le=1)] = 0.005
    target_entropy: float | None = None


Settings = PPOSettings | SACSettings
ALGORITHMS: dict[str, type[Settings]] = {"ppo": PPOSettings, "sac": SACSettings}


def train_settings(algorithm: str, given: Mapping[str, Any]) -> Settings:
    """Return the settings of a config's ``train``.

    Raises:
        InputError: an unknown key, or a value that does not fit.
    """
    kind = ALGORITHMS[algorithm]
    check_keys(given, [field.alias or name for name, field in kind.model_fields.items()], f"train of {algorithm}")
    for key, value in given.items():
        if isinstance(value, bool) and key not in ("anneal", "privileged_critic"):
            raise InputError(f"train.{key} is {str(value).lower()}; expected a number")
    try:
        return kind(**given)
    except pydantic.ValidationError as error:
        raise InputError(f"train.{explained(error, given)}") from None
