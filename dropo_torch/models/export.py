"""A fitted model as MJCF, for programs that know nothing of this package."""

from __future__ import annotations

import warnings
from pathlib import Path

import mujoco
import numpy as np

from dropo_torch.errors import InputError
from dropo_torch.models.constants import derive
from dropo_torch.parameters import ParameterSpace, read_field

#: MJCF is written with six significant digits.
PRECISION = 2e-5


def export_model(source: str | Path, space: ParameterSpace, values: np.ndarray, path: str | Path) -> None:
    """Write the model ``source`` with parameter values ``(d,)``, in units, as a self-contained MJCF file.

    Inertias that the compiler would infer from geoms are written out, and asset folders become
    absolute paths. The file is read back and compared before it counts as written.

    Raises:
        InputError: a source that is no XML file, or a parameter that MJCF cannot express.
    """
    spec, path = read_spec(source), Path(path)
    if any(f in ("body_mass", "body_inertia", "body_ipos", "body_iquat") for f in space.fields):
        write_inertials(spec)
    model = spec.compile()
    space.write_into(model, values)
    wanted = [(space.names[column], target, target.read(model)) for column, target in space.targets]
    try:
        derive(model)
        spec.copy_back(model)
        path.write_text(spec.to_xml(), encoding="utf-8")
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(f"export: MJCF cannot express these parameters: {error}") from None
    try:
        written = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        path.unlink()
        raise InputError(f"export: MuJoCo refuses the model with these parameters: {error}") from None
    for name, target, value in wanted:
        found = float(read_field(written, target.field).reshape(-1)[target.index])
        if abs(found - value) > PRECISION * max(abs(value), 1e-6):
            path.unlink()
            raise InputError(f"export: MJCF gives {found:g} for {name} instead of {value:g}")


def read_spec(source: str | Path) -> mujoco.MjSpec:
    """Read a model that is to be written elsewhere: its asset folders become absolute.

    Raises:
        InputError: a source that is no XML file, or that MuJoCo does not read.
    """
    source = Path(source).resolve()
    if source.suffix not in (".xml", ".urdf", ".mjcf"):
        raise InputError(f"export: {source} is no XML model; only those can be written as MJCF")
    try:
        spec = mujoco.MjSpec.from_file(str(source))
    except ValueError as error:
        raise InputError(f"export: MuJoCo does not read {source}: {error}") from None
    for folder in ("meshdir", "texturedir") if spec.meshes or spec.textures or spec.hfields or spec.skins else ():
        setattr(spec, folder, str((source.parent / getattr(spec, folder)).resolve()))
    return spec


def write_inertials(spec: mujoco.MjSpec) -> None:
    """Give every body the inertial that it compiles to, explicitly, and let the compiler change none of them again."""
    with warnings.catch_warnings(action="ignore"):
        compiled = spec.compile()
    for body in spec.bodies[1:]:
        body.explicitinertial = True
        body.fullinertia = np.full(6, np.nan)
        body.mass, body.inertia = compiled.body_mass[body.id], compiled.body_inertia[body.id]
        body.ipos, body.iquat = compiled.body_ipos[body.id], compiled.body_iquat[body.id]
    compiler = spec.compiler
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    compiler.settotalmass, compiler.boundmass, compiler.boundinertia, compiler.balanceinertia = -1.0, 0.0, 0.0, False
