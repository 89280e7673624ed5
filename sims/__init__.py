"""Bundled simulations: models, parameter spaces and logs to try the package on."""
