"""Fits of logs that show sensors instead of states: multiple shooting with free initial states."""

from dropo_torch.shooting.result import fit_sensed as fit_sensed
