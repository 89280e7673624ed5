"""Robots with hidden effects, simulated by plain MuJoCo: their models, truths and logs, and a judge of answers."""
