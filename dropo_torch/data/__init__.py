"""Logs: file formats, preprocessing, what the columns are, and the trajectories and transitions they become."""
