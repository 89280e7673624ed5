"""How long work says how far it is."""

from collections.abc import Callable

#: ``report(stage, share)``: what is being done, in words, and the share of it that is done.
Report = Callable[[str, float], None]
