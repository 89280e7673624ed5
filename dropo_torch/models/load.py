"""Loading MuJoCo models, with errors that say which file and why."""

from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from dropo_torch.errors import InputError
from dropo_torch.models.constants import put_weights
from dropo_torch.support.child import limit_memory, read_in_child


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


#: Bytes that a binary model and its simulation may take besides some times its file: a damaged one may ask for all.
ROOM = 2**30
#: Fields of whole numbers that are no addresses, by how their names end.
PLAIN = re.compile(
    "_(signature|group|contype|conaffinity|condim|priority|mode|resolution|width|height|nchannel|size|dim|depth|"
    "type|dyntype|gaintype|biastype|trntype|objtype|reftype|datatype|needstage|intprm|history|ctrlspec|output|"
    "projection|colorspace|data|policy|interp|passive|selfcollide|activelayers|simple|sameframe|plasticmode|attr)$"
)
#: Fields of bodies that MuJoCo takes for granted where it has compiled the body as simple.
CENTERS = ("body_ipos", "body_iquat")


def load_model(model: mujoco.MjModel | str | Path, *, general: bool = False) -> mujoco.MjModel:
    """Return ``model``, compiled from MJCF, URDF or MJB when it is a path.

    With ``general``, a free body whose center of mass is its frame's is compiled without MuJoCo's short cuts for such
    bodies, so that the center and the axes may move.

    Raises:
        InputError: a missing file, or one that MuJoCo does not compile, with MuJoCo's reason.
    """
    if isinstance(model, mujoco.MjModel):
        return model
    path = Path(model)
    if not path.is_file():
        raise InputError(f"model: no file {path}; expected the path of an MJCF (.xml), URDF or .mjb file")
    if path.suffix == ".mjb":  # MuJoCo trusts its sizes: a damaged file may crash it, or ask for all memory
        read_in_child(f"{__name__}:try_binary", path, where=f"model: {path}", kind="a model of this MuJoCo")
    try:
        with quiet_mujoco(), warnings.catch_warnings(action="ignore"):  # of attributes that will be gone some day
            return checked(_loaded(path, general), f"model: {path}")
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(f"model: MuJoCo does not compile {path}: {error}") from None


def _loaded(path: Path, general: bool) -> mujoco.MjModel:
    if path.suffix == ".mjb":
        return mujoco.MjModel.from_binary_path(str(path))
    if not general:
        return mujoco.MjModel.from_xml_path(str(path))
    spec = mujoco.MjSpec.from_file(str(path))
    unsimplify(spec)
    model = spec.compile()
    put_weights(model)
    return model


def try_binary(path: str) -> bytes:
    """Load a binary model and simulate a step of it, whatever becomes of it; return nothing.

    Raises:
        ValueError: no model, or one whose file has another size than it needs.
    """
    limit_memory(ROOM + 8 * Path(path).stat().st_size)
    with quiet_mujoco():
        model = mujoco.MjModel.from_binary_path(path)
        if mujoco.mj_sizeModel(model) != Path(path).stat().st_size:
            raise ValueError("its size is not that of its contents")
        check_addresses(model)
        mujoco.mj_step(model, mujoco.MjData(model))
    return b""


def check_addresses(model: mujoco.MjModel) -> None:
    """Refuse a binary model with a whole number that addresses nothing; MuJoCo itself checks only some of them.

    Raises:
        ValueError: naming the field.
    """
    arrays = {n: v for n in dir(model) if not n.startswith("_") and isinstance(v := getattr(model, n), np.ndarray)}
    longest = max(len(model.names), len(model.paths), *(a.size for a in arrays.values()))
    limits = {"bvh_nodeid": max(model.ngeom, model.nmeshface, model.nflexelem, model.nflexvert) - 1}
    for name, values in arrays.items():
        if values.dtype.kind in "iu" and values.size and not PLAIN.search(name):
            largest = int(np.abs(values.astype(np.int64)).max())
            if largest > limits.get(name, longest):
                raise ValueError(f"{name} has {largest}, which addresses nothing")


def checked(model: mujoco.MjModel, where: str) -> mujoco.MjModel:
    """Return a model all of whose numbers are finite, whose names are text, and whose step is positive.

    Raises:
        InputError: another one, naming the field.
    """
    for part in (model, model.opt, model.stat):
        for name in (n for n in dir(part) if not n.startswith("_")):
            values = getattr(part, name)
            if isinstance(values, np.ndarray | float) and not np.isfinite(values).all():
                raise InputError(f"{where}: {name} has a value that is not finite")
    try:
        model.names.decode()
    except UnicodeDecodeError:
        raise InputError(f"{where}: a name in it is no text in UTF-8; save the file in UTF-8") from None
    if model.opt.timestep <= 0:
        raise InputError(f"{where}: timestep is {model.opt.timestep:g}; expected a positive number of seconds")
    return model


def unsimplify(spec: mujoco.MjSpec) -> None:
    """Let every body's center and axes move after compilation."""
    for body in spec.bodies[1:]:
        body.simple = 0


def show_divergence(model: mujoco.MjModel) -> mujoco.MjModel:
    """Let a simulation that diverges stay so, rather than begin anew; return the model, which is changed."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model
