"""A config from a model and a log alone: which column is what, how fast, how noisy, and what can be fitted."""

from dropo_torch.proposal.choice import Choice, Group, Told
from dropo_torch.proposal.clock import Clock
from dropo_torch.proposal.matches import Match, Matching
from dropo_torch.proposal.propose import Proposal, Review, propose_config

__all__ = ["Choice", "Clock", "Group", "Match", "Matching", "Proposal", "Review", "Told", "propose_config"]
