"""Loading MuJoCo models, with errors that say which file and why."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import mujoco

from dropo_torch.errors import InputError


class _LogConfig(ctypes.Structure):
    """MuJoCo's ``mjLogConfig``."""

    _fields_ = (
        ("console", ctypes.c_bool),
        ("file", ctypes.c_bool),
        ("path", ctypes.c_char * 1024),
        ("topics", ctypes.c_int),
    )


@cache
def _library() -> ctypes.CDLL | None:
    """MuJoCo's C library, which is already loaded; ``None`` where it is not found under its usual name."""
    for path in sorted(Path(mujoco.__file__).parent.glob("*mujoco*")):
        if path.suffix in (".dll", ".dylib") or ".so." in path.name:
            library = ctypes.CDLL(str(path))
            library.mju_getLogConfig.restype = _LogConfig
            library.mju_setLogConfig.argtypes = [_LogConfig]
            library.mju_setLogConfig.restype = None
            return library
    return None


@contextlib.contextmanager
def quiet_mujoco() -> Iterator[None]:
    """Keep MuJoCo from printing warnings and writing MUJOCO_LOG.TXT; errors are raised as ever.

    A simulation that diverges under an unlikely parameter is no news: its result says so.
    """
    library = _library()
    if library is None:
        yield
        return
    before = library.mju_getLogConfig()
    library.mju_setLogConfig(_LogConfig(False, False, before.path, before.topics))
    try:
        yield
    finally:
        library.mju_setLogConfig(before)


#: Fields of bodies that MuJoCo takes for granted where it has compiled the body as simple.
CENTRES = ("body_ipos", "body_iquat")


def load_model(model: mujoco.MjModel | str | Path, *, general: bool = False) -> mujoco.MjModel:
    """Return ``model``, compiled from MJCF, URDF or MJB when it is a path.

    With ``general``, a free body whose centre of mass is its frame's is compiled without MuJoCo's short cuts for such
    bodies, so that the centre and the axes may move.

    Raises:
        InputError: a missing file, or one that MuJoCo does not compile, with MuJoCo's reason.
    """
    if isinstance(model, mujoco.MjModel):
        return model
    path = Path(model)
    if not path.is_file():
        raise InputError(f"model: no file {path}; expected the path of an MJCF (.xml), URDF or .mjb file")
    try:
        with quiet_mujoco():
            if path.suffix == ".mjb":
                return mujoco.MjModel.from_binary_path(str(path))
            if not general:
                return mujoco.MjModel.from_xml_path(str(path))
            spec = mujoco.MjSpec.from_file(str(path))
            unsimplify(spec)
            return spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"model: MuJoCo does not compile {path}: {reason}") from None


def unsimplify(spec: mujoco.MjSpec) -> None:
    """Let every body's centre and axes move after compilation."""
    for body in spec.bodies[1:]:
        body.simple = 0
