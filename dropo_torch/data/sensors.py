"""A model's sensors as columns of a log: their names and units, and which of them are a state's own columns."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from dropo_torch.errors import InputError

_S = mujoco.mjtSensor
_XYZ, _XY, _WXYZ = ("[x]", "[y]", "[z]"), ("[x]", "[y]"), ("[qw]", "[qx]", "[qy]", "[qz]")
#: Kind of sensor → the suffixes of its columns and their unit; others are numbered and have none.
_KINDS: dict[int, tuple[tuple[str, ...], str]] = {
    int(kind): (suffixes, unit)
    for suffixes, unit, kinds in (
        (("",), "N", (_S.mjSENS_TOUCH,)),
        (("",), "m", (_S.mjSENS_RANGEFINDER, _S.mjSENS_GEOMDIST)),
        (("",), "J", (_S.mjSENS_E_POTENTIAL, _S.mjSENS_E_KINETIC)),
        (("",), "s", (_S.mjSENS_CLOCK,)),
        (_XY, "pixel", (_S.mjSENS_CAMPROJECTION,)),
        (_XYZ, "m", (_S.mjSENS_FRAMEPOS, _S.mjSENS_SUBTREECOM)),
        (_XYZ, "m/s", (_S.mjSENS_VELOCIMETER, _S.mjSENS_FRAMELINVEL, _S.mjSENS_SUBTREELINVEL)),
        (_XYZ, "m/s²", (_S.mjSENS_ACCELEROMETER, _S.mjSENS_FRAMELINACC)),
        (_XYZ, "rad/s", (_S.mjSENS_GYRO, _S.mjSENS_FRAMEANGVEL, _S.mjSENS_BALLANGVEL)),
        (_XYZ, "rad/s²", (_S.mjSENS_FRAMEANGACC,)),
        (_XYZ, "N", (_S.mjSENS_FORCE,)),
        (_XYZ, "N m", (_S.mjSENS_TORQUE,)),
        (_XYZ, "T", (_S.mjSENS_MAGNETOMETER,)),
        (_XYZ, "-", (_S.mjSENS_FRAMEXAXIS, _S.mjSENS_FRAMEYAXIS, _S.mjSENS_FRAMEZAXIS, _S.mjSENS_GEOMNORMAL)),
        (_WXYZ, "-", (_S.mjSENS_FRAMEQUAT, _S.mjSENS_BALLQUAT)),
    )
    for kind in kinds
}  # fmt: skip
#: Sensors that show columns of the state: whether positions.
_OF_STATE = {
    int(_S.mjSENS_JOINTPOS): True, int(_S.mjSENS_BALLQUAT): True,
    int(_S.mjSENS_JOINTVEL): False, int(_S.mjSENS_BALLANGVEL): False,
}  # fmt: skip
#: Sensors whose values somebody's own code makes.
_FOREIGN = (int(_S.mjSENS_USER), int(_S.mjSENS_PLUGIN))


@dataclass(frozen=True)
class Sensor:
    """A sensor, and its columns in the extended state ``[qpos, qvel, sensordata]``.

    Attributes:
        name: its name, or ``sensor3`` where it has none.
        columns: column → label and unit, in the sensor's order. Encoders of a joint are columns of the state itself.
        is_quaternion: whether the columns are w, x, y, z of an orientation.
        refusal: why it cannot be simulated, in words; empty where it can.
    """

    name: str
    columns: dict[int, tuple[str, str]]
    is_quaternion: bool
    refusal: str

    def check(self) -> None:
        """Raise an :class:`InputError` where the sensor cannot be simulated."""
        if self.refusal:
            raise InputError(f"observation: sensor[{self.name}] {self.refusal}")


def sensors_of(model: mujoco.MjModel, state: dict[int, tuple[str, str]]) -> list[Sensor]:
    """Return the sensors of a model.

    Args:
        model: the model.
        state: label and unit of each column of the state.
    """
    return [_sensor(model, i, state) for i in range(model.nsensor)]


def _sensor(model: mujoco.MjModel, i: int, state: dict[int, tuple[str, str]]) -> Sensor:
    kind, dim, name = int(model.sensor_type[i]), int(model.sensor_dim[i]), model.sensor(i).name or f"sensor{i}"
    refusal = ""
    if kind in _FOREIGN:
        refusal = "is computed by code outside the model, which cannot be simulated"
    elif int(model.sensor_history[i, 0]) > 0:
        refusal = "has a delay or an interval in the model, whose past no log holds; take it out of the model and say "
        refusal += "data: {preprocess: {delays: ...}}"
    is_quaternion = kind in (int(_S.mjSENS_FRAMEQUAT), int(_S.mjSENS_BALLQUAT))
    if kind in _OF_STATE and model.sensor_cutoff[i] <= 0:
        joint = int(model.sensor_objid[i])
        first = int(model.jnt_qposadr[joint]) if _OF_STATE[kind] else model.nq + int(model.jnt_dofadr[joint])
        return Sensor(name, {c: state[c] for c in range(first, first + dim)}, is_quaternion, refusal)
    suffixes, unit = _KINDS.get(kind, ((), ""))
    if len(suffixes) != dim:
        suffixes = ("",) if dim == 1 else tuple(f"[{k}]" for k in range(dim))
    first = model.nq + model.nv + int(model.sensor_adr[i])
    columns = {first + k: (f"{name}{suffix}", unit) for k, suffix in enumerate(suffixes)}
    return Sensor(name, columns, is_quaternion, refusal)
