"""Loading MuJoCo models, with errors that say which file and why."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path

import mujoco

from dropo_torch.errors import InputError


@contextlib.contextmanager
def quiet_mujoco() -> Iterator[None]:
    """Keep MuJoCo from printing warnings and writing MUJOCO_LOG.TXT; errors are raised as ever.

    A simulation that diverges under an unlikely parameter is no news: its result says so.
    """
    before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logto_console = quiet.logto_file = False
    quiet.set()
    try:
        yield
    finally:
        before.set()


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
        with quiet_mujoco(), warnings.catch_warnings(action="ignore"):  # of attributes that will be gone some day
            if path.suffix == ".mjb":
                return mujoco.MjModel.from_binary_path(str(path))
            if not general:
                return mujoco.MjModel.from_xml_path(str(path))
            spec = mujoco.MjSpec.from_file(str(path))
            unsimplify(spec)
            return spec.compile()
    except ValueError as error:
        raise InputError(f"model: MuJoCo does not compile {path}: {error}") from None


def unsimplify(spec: mujoco.MjSpec) -> None:
    """Let every body's centre and axes move after compilation."""
    for body in spec.bodies[1:]:
        body.simple = 0


def show_divergence(model: mujoco.MjModel) -> mujoco.MjModel:
    """Let a simulation that diverges stay so, rather than begin anew; return the model, which is changed."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model
