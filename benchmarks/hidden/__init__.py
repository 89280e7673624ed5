"""Logs in which an effect is hidden: systems, effects as explicit forces and filters, and a list of cases."""
