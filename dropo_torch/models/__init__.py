"""Models: loading MJCF, writing it with fitted values, and the models that come with packages."""
