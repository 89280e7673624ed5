# What there is to see, read by type checkers and, at import, by lazy_loader.
from .replay import Stretch as Stretch
from .replay import Take as Take
from .replay import View as View
from .replay import make_view as make_view
from .run import Candidate as Candidate
from .run import Run as Run
from .run import read_run as read_run
from .video import write_video as write_video
