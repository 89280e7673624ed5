"""Fit a distribution over a simulator's dynamics parameters to a log of the real robot."""
