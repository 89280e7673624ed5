"""Fit a distribution over a simulator's dynamics parameters to a log of the real robot.

>>> import dropo_torch as dropo
>>> problem = dropo.make_problem(dropo.load_config("robot.yaml"))
>>> result = dropo.fit_problem(problem)
>>> result.distribution.save("distribution.json")

The public names stand in ``__init__.pyi``; each is imported when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
