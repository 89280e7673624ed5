"""Loading MuJoCo models, with errors that say which file and why."""

from __future__ import annotations

from pathlib import Path

import mujoco

from dropo_torch.errors import InputError


def load_model(model: mujoco.MjModel | str | Path) -> mujoco.MjModel:
    """Return ``model``, compiled from MJCF, URDF or MJB when it is a path.

    Raises:
        InputError: a missing file, or one that MuJoCo does not compile, with MuJoCo's reason.
    """
    if isinstance(model, mujoco.MjModel):
        return model
    path = Path(model)
    if not path.is_file():
        raise InputError(f"model: no file {path}; expected the path of an MJCF (.xml), URDF or .mjb file")
    try:
        if path.suffix == ".mjb":
            return mujoco.MjModel.from_binary_path(str(path))
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"model: MuJoCo does not compile {path}: {reason}") from None
