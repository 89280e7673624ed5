"""A generator of hits: a variational autoencoder of motions that the arm can make, in whose latent space one acts.

``python -m dropo_sims.puck.generator`` generates scripted hits (:mod:`dropo_sims.puck.policy`), trains the autoencoder
on them and writes the decoder's weights, which are bundled. As in the paper, where an action is a point z of the latent
space and stands for the whole motion.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from scipy.interpolate import CubicSpline
from torch import nn
from torch.nn import functional

from dropo_torch.models.load import load_model

from . import SIM
from .policy import Hit, hit_targets

WEIGHTS = Path(__file__).parent / "generator.safetensors"
#: Numbers of a point z, joints, knots of a motion and its targets, one every 10 ms.
LATENT, JOINTS, KNOTS, STEPS = 3, 7, 30, 300
#: Knots before the strike's approach ends are few, for there is little to say.
_AT = np.unique(np.round(np.concatenate([np.linspace(0, 140, 8), np.linspace(150, STEPS - 1, KNOTS - 8)]))).astype(int)
#: Of the hits that are generated: standard deviations of heading, rad, and side, m; least and largest speed, m/s.
HEADING, SIDE, SPEEDS = 0.3, 0.01, (0.45, 1.0)
#: Weight of the divergence of z from N(0, I).
BETA = 2e-3


class Decoder(nn.Module):
    """Motions of points z, by a network that gives knots, and a cubic spline through them."""

    center: torch.Tensor
    scale: torch.Tensor
    spline: torch.Tensor

    def __init__(self, hidden: int = 128) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(LATENT, hidden), nn.Tanh(), nn.Linear(hidden, hidden), nn.Tanh(),
            nn.Linear(hidden, KNOTS * JOINTS),
        )  # fmt: skip
        self.register_buffer("center", torch.zeros(KNOTS, JOINTS))
        self.register_buffer("scale", torch.ones(KNOTS, JOINTS))
        spline = CubicSpline(_AT, np.eye(KNOTS), bc_type="natural")(np.arange(STEPS))
        self.register_buffer("spline", torch.from_numpy(spline).float(), persistent=False)

    def knots(self, z: torch.Tensor) -> torch.Tensor:
        """Return knots ``(N, KNOTS, 7)`` of points ``(N, LATENT)``, in shares of how much they vary."""
        return self.net(z).unflatten(-1, (KNOTS, JOINTS))

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        """Return the positions that the joints' servos are given, ``(N, STEPS, 7)``, rad."""
        return self.spline @ (self.center + self.scale * self.knots(z))


def load_decoder(path: str | Path = WEIGHTS) -> Decoder:
    """Return the decoder with the weights of a file, by default the bundled ones; it is not trained further."""
    decoder = Decoder()
    decoder.load_state_dict(load_file(str(path)))
    return decoder.eval().requires_grad_(False)


def scripted_hits(count: int, seed: int) -> torch.Tensor:
    """Return knots of scripted hits, ``(count, KNOTS, 7)``, rad."""
    model, generator = load_model(SIM.model), np.random.default_rng(seed)
    headings, sides = generator.normal(0, [[HEADING], [SIDE]], (2, count)).tolist()
    drawn = zip(headings, sides, generator.uniform(*SPEEDS, count).tolist(), strict=True)
    hits = [hit_targets(model, Hit(*numbers), STEPS)[_AT] for numbers in drawn]
    return torch.from_numpy(np.stack(hits)).float()


def train_decoder(motions: torch.Tensor, epochs: int = 3000, seed: int = 0) -> tuple[Decoder, float]:
    """Train an autoencoder on knots of motions ``(N, KNOTS, 7)``; return its decoder and what it misses, rms in rad."""
    torch.manual_seed(seed)
    decoder = Decoder()
    center = motions.mean(0)
    scale = (motions - center).square().mean(0).sqrt().clamp(min=0.02)
    decoder.center.copy_(center)
    decoder.scale.copy_(scale)
    shares = (motions - center) / scale
    encoder = nn.Sequential(nn.Linear(KNOTS * JOINTS, 128), nn.Tanh(), nn.Linear(128, 2 * LATENT))
    parameters = [*encoder.parameters(), *decoder.parameters()]
    optimizer = torch.optim.Adam(parameters, 2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    for _ in range(epochs):
        mean, log_std = encoder(shares.flatten(1)).chunk(2, -1)
        z = mean + log_std.exp() * torch.randn_like(mean)
        missed = functional.mse_loss(decoder.knots(z), shares)
        divergence = 0.5 * (mean.square() + (2 * log_std).exp() - 2 * log_std - 1).sum(-1).mean()
        optimizer.zero_grad()
        (missed + BETA * divergence).backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        mean = encoder(shares.flatten(1))[:, :LATENT]
        error = float((scale * (decoder.knots(mean) - shares)).square().mean().sqrt())
    return decoder.eval(), error


def main(arguments: Sequence[str] | None = None) -> None:
    """Generate hits, train on them, and write the decoder's weights."""
    parser = argparse.ArgumentParser(description="Train the generator of hits.")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="the .safetensors file to write")
    parser.add_argument("--hits", type=int, default=400)
    parser.add_argument("--epochs", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    if min(given.hits, given.epochs) < 1 or given.seed < 0:
        parser.error(f"hits {given.hits}, epochs {given.epochs}, seed {given.seed}: expected 1, 1 and 0 or more")
    if not given.out.parent.is_dir():
        parser.error(f"--out: no folder {given.out.parent}; make it first, or name another file")
    motions = scripted_hits(given.hits, given.seed)
    print(f"{given.hits} hits of {STEPS} targets")
    decoder, error = train_decoder(motions, given.epochs, given.seed)
    save_file({name: value.contiguous() for name, value in decoder.state_dict().items()}, str(given.out))
    print(f"{given.out}: motions are missed by {error:.2g} rad, rms")


if __name__ == "__main__":
    main()
