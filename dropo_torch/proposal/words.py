"""What a column's name says: its role, its unit, and which object and number it speaks of."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

Role = Literal["position", "velocity", "acceleration", "effort", "command", "time", "episode", "flag", "other", ""]


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


#: Words of names, by what they make of a column.
_ROLES: dict[Role, frozenset[str]] = {
    "position": _set(
        "q qpos pos position positions angle angles theta th phi psi alpha beta enc encoder pose p winkel lage"
    ),
    "velocity": _set(
        "dq qd qdot qvel vel velo velocity velocities spd speed speeds omega dot rate v twist gyro angvel linvel "
        "drehzahl geschwindigkeit vitesse"
    ),
    "acceleration": _set("ddq qdd qddot acc accel acceleration qacc"),
    "effort": _set(
        "tau torque torques effort efforts force forces thrust tension tensions moment current curr load frc "
        "drehmoment kraft couple"
    ),
    "command": _set(
        "cmd cmds command commands commanded u ctrl control controls action actions act input inputs "
        "target targets des desired ref reference setpoint setp goal sp pwm throttle duty soll sollwert "
        "sollwerte consigne"
    ),
    "time": _set(
        "t time times timestamp timestamps stamp clock sec secs seconds epoch unix utc elapsed uptime millis micros "
        "zeit nanos msec usec nsec"
    ),
    "episode": _set(
        "episode episodes ep run trial traj trajectory demo rollout segment take experiment"
    ),
    "flag": _set("done dones terminal terminals terminated truncated timeout timeouts reset"),
    "other": _set(
        "temp temperature error err status mode battery seq frame id std var cov reward rewards next"
    ),
}  # fmt: skip
#: What drives a motor, unless it is that of a supply; and its unit at the end of a name that says so.
_VOLTAGE, _SUPPLY, _IN_VOLTS = (
    _set("voltage voltages volt volts"), _set("battery batt bat vbat bus supply pack rail logic vcc vdd cell"),
    re.compile(r"[\s_(\[]V[)\]]?$"),
)  # fmt: skip
#: A current, unless it stands beside a kind of motion: the one at present.
_CURRENT = _set("current curr")
#: Words of commands that are positions to be reached.
_TARGETS = _set("target targets des desired ref reference setpoint setp goal sp soll sollwert sollwerte consigne")
#: Words of units → what the value is multiplied by to be SI.
UNITS: dict[str, float] = {
    "deg": math.pi / 180, "degs": math.pi / 180, "degree": math.pi / 180, "degrees": math.pi / 180,
    "dps": math.pi / 180, "degps": math.pi / 180, "radps": 1.0, "rpm": math.pi / 30, "rad": 1.0, "rads": 1.0,
    "radian": 1.0, "radians": 1.0, "mrad": 1e-3, "mm": 1e-3,
    "mmps": 1e-3, "cm": 1e-2, "meter": 1.0, "meters": 1.0, "nm": 1.0, "newton": 1.0, "mnm": 1e-3,
    "um": 1e-6, "inch": 0.0254, "revs": math.tau, "revps": math.tau, "ncm": 1e-2, "knm": 1e3, "kilonewton": 1e3,
}  # fmt: skip
#: Units as people write them, where marks and capitals tell what they are, and as words of :data:`UNITS`.
_WRITTEN = tuple(
    (re.compile(pattern), f" {word} ")
    for pattern, word in (
        (r"[°º˚]\s*/\s*s(ec)?(?![A-Za-z²])", "dps"), (r"[°º˚](?!\s*[CF])", "deg"),
        (r"(?<![A-Za-z])mN\s?[·*.]?\s?m(?![A-Za-z])", "mnm"), (r"(?<![A-Za-z])N\s?[·*.]?\s?cm(?![A-Za-z])", "ncm"),
        (r"(?<![A-Za-z])kN\s?[·*.]?\s?m(?![A-Za-z])", "knm"), (r"(?<![A-Za-z])kN(?![A-Za-z])", "kilonewton"),
        (r"(?<![A-Za-z])N\s?[·*.]\s?m(?![A-Za-z])", "nm"), (r"[µμ]m(?![A-Za-z])", "um"), (r"[µμ]s(?![A-Za-z])", "us"),
        (r"(?<![A-Za-z])(revs?|turns?|rot)\s?/\s?s(ec)?(?![A-Za-z])|(?<![A-Za-z])rps(?![A-Za-z])", "revps"),
        (r"[\[(]\s*(revs?|turns?|rot)\s*[\])]|(?<=[_ ])(revs|turns)$", "revs"), (r"[\[(]\s*N m\s*[\])]", "nm"),
        (r"[\[(]\s*(in|inch|inches)\s*[\])]", "inch"),
    )
)  # fmt: skip
#: Words of hundredths of a range, and of what is so commanded.
_PERCENT, _OPENS = _set("pct percent perc"), _set("valve spool pump")
#: Of commands the actuator's, of measurements that they are actual ones.
_ACT = "act"
#: Units that count only as a name's last word: they are letters with other meanings, too.
_LAST = {"m": 1.0, "s": 1.0, "n": 1.0, "mps": 1.0}
#: Units of velocities, of efforts, and of which names do not tell; others are of positions.
_RATES, _EFFORTS, _EITHER = (
    _set("dps degps radps rpm revps mmps mps"),
    _set("nm mnm ncm knm kilonewton newton n"),
    _set("degs rads s"),
)
#: Units of time stamps → seconds.
TIME_UNITS = {
    "s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "msecs": 1e-3,
    "millis": 1e-3, "milliseconds": 1e-3, "us": 1e-6, "usec": 1e-6, "usecs": 1e-6, "micros": 1e-6,
    "microseconds": 1e-6, "ns": 1e-9, "nsec": 1e-9, "nsecs": 1e-9, "nanosec": 1e-9, "nanosecs": 1e-9, "nanos": 1e-9,
    "nanoseconds": 1e-9,
}  # fmt: skip
#: Words of what an encoder counts: how many make a turn or a meter, no name tells.
COUNTS = _set("tick ticks counts cnts pulses lsb")
#: Words of angles.
_TURNS = _set("angle angles theta th phi psi alpha beta thetadot phidot dtheta dphi")
#: Words that tell nothing.
_EMPTY = _set(
    "joint joints jnt state states data sensor sensors robot measured meas actual present value values body link obs "
    "observation observations header log signal motor servo of the ist istwert istwerte messwert achse mesure"
)
#: Words of quaternions, and of linear and angular velocities.
_QUATERNION = _set("quat quaternion orientation rot rotation ori")
_ANGULAR = _set("angular ang gyro omega angvel")
_LINEAR = _set("linear lin linvel")
_AXES = ("x", "y", "z")
#: Kinds of short words of axes, where they are no positions.
_MEANT: dict[str, Role] = {"velocity": "velocity", "angular": "velocity", "acceleration": "acceleration"}


@dataclass(frozen=True)
class Words:
    """What a name says.

    Attributes:
        role: what kind of column it is; empty where the name does not say.
        scale: factor of its unit to SI; ``None`` where the name has none.
        objects: words that name an object.
        numbers: numbers in the name, in order.
        axis: ``x``, ``y``, ``z``, or ``w`` of a quaternion; empty for none.
        quaternion: whether it is a quaternion's component.
        angular: whether it is an angular velocity about an axis.
        commanded: of a command, the role of what it commands: ``position``, ``velocity``, ``effort``, or empty.
        turns: whether it is called an angle.
        percent: whether it is told in hundredths of a range.
    """

    role: Role = ""
    scale: float | None = None
    objects: tuple[str, ...] = ()
    numbers: tuple[int, ...] = ()
    axis: str = ""
    quaternion: bool = False
    angular: bool = False
    commanded: Role = ""
    turns: bool = False
    percent: bool = False


def split(name: str) -> list[str]:
    """Return the words and numbers of a name in small letters: at marks, capitals and digits."""
    for pattern, word in _WRITTEN:
        name = pattern.sub(word, name)
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return re.findall(r"[a-z]+|\d+", spaced.lower())


def object_words(name: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return the words and the numbers by which a model's object is known."""
    parts = split(name)
    kept = tuple(w for w in parts if not w.isdigit() and w not in _EMPTY)
    return kept, tuple(int(w) for w in parts if w.isdigit())


def called(name: str, words: Words) -> tuple[tuple[str, ...], ...]:
    """Return what a column's name may be the name of: all of it, then it without its unit and without its command.

    Args:
        name: of the column.
        words: what it says: what stands in a joint's name is neither.
    """
    every = split(name)
    found = [every, _unit(every)[0] if words.scale is not None else every]
    found += [[word for word in every if word not in _PERCENT]] if words.percent else []
    if words.role == "command":
        bare = [w for w in (part for word in found[-1] for part in _parts(word)) if w not in _ROLES["command"]]
        found += [bare, [w for w in bare if _role(w) not in ("position", "velocity", "effort")]]
    return tuple(dict.fromkeys(tuple(said) for said in found if said))


def unit_role(name: str) -> Role:
    """Return of what kind of column the unit in a name is: position, velocity or effort; empty where it is open."""
    every = split(name)
    own = set((Counter(every) - Counter(_unit(every)[0])).elements())
    if own & _EFFORTS:
        return "effort"
    return "velocity" if own & _RATES or ("s" in own and len(own) > 1) else "position" if own - _EITHER else ""


def read_name(name: str, known: Sequence[str] = ()) -> Words:
    """Return what a column's name says.

    Args:
        name: of the column.
        known: names of the model's objects: what stands in one of these, such as ``target_x``, says nothing else.
    """
    every = split(name)
    for own in sorted((split(other) for other in known if _misleads(other)), key=len, reverse=True):
        begins = [i for i in range(len(every) - len(own) + 1) if every[i : i + len(own)] == own]
        if begins:
            rest = read_name(" ".join(every[: begins[0]] + every[begins[0] + len(own) :]))
            objects, number = object_words(" ".join(own))
            return replace(rest, objects=objects + rest.objects, numbers=number + rest.numbers)
    words, numbers = [w for w in every if not w.isdigit()], tuple(int(w) for w in every if w.isdigit())
    words = [part for w in words for part in _parts(w)]
    percent, words = bool(set(words) & _PERCENT), [word for word in words if word not in _PERCENT]
    driven = {word for word in words if word in _VOLTAGE and not _SUPPLY & set(words)}
    if _IN_VOLTS.search(name) and (driven or any(_role(word) == "command" for word in words)):
        words = words[:-1]
    words, scale = _unit(words)
    axis, quaternion, angular = "", False, False
    roles: list[Role] = []
    said: list[str] = []
    commanded: Role = ""
    if any(_role(word) in ("position", "velocity", "acceleration") for word in words):
        words = [word for word in words if word not in _CURRENT]
    forces = unit_role(name) == "effort" and any(_role(word) == "command" for word in words)
    for word in words:
        short = _short(word)
        if short is not None and short[0] == "acceleration" and (scale or any(map(_role, words))):
            short = None  # az_deg and az_rate are an azimuth's
        if short is not None:
            kind, letter = short
            axis = letter
            quaternion |= kind == "quaternion"
            angular |= kind == "angular"
            roles.append(_MEANT.get(kind, "position"))
            continue
        role = "command" if word in driven or (percent and word in _OPENS) else _role(word)
        role = "other" if word in _VOLTAGE - driven else role
        role = "" if forces and len(word) == 1 and role in ("position", "velocity") else role  # cmd_v_N: vertical
        if role:
            roles.append(role)
            commanded = "position" if word in _TARGETS and not commanded else commanded
            angular |= word in _ANGULAR
        elif word in _AXES or (word == "w" and (quaternion or set(words) & _QUATERNION)):
            axis = word
        elif word in _QUATERNION:
            quaternion = True
        elif word in _ANGULAR or word in _LINEAR:
            angular |= word in _ANGULAR
        elif word not in _EMPTY:
            said.append(word)
    if not angular and axis and "velocity" in roles and set(words) & _ANGULAR:
        angular = True
    role, commanded = _decided(roles, commanded)
    if quaternion and role in ("", "other"):
        role = "position"
    turns = bool(set(words) & _TURNS)
    return Words(
        role, scale, tuple(said), numbers, axis, quaternion and not angular, angular, commanded, turns, percent
    )


def _misleads(name: str) -> bool:
    """Whether an object's name has words that would say what kind of column it is, were they not its name."""
    told, linear = read_name(name), set(split(name)) & _LINEAR
    return len(name) > 1 and bool(told.role or told.quaternion or told.angular or linear or told.scale is not None)


def says_kind(name: str) -> bool:
    """Return whether a name has a word of a kind of columns, such as ``position``."""
    return any(_role(word) in ("position", "velocity", "effort", "command") for word in split(name))


def desired(names: Sequence[str], alike: Callable[[int, int], bool]) -> list[str]:
    """Return names with ``des`` for a lone ``d`` where another column is called alike but for that.

    Beside ``tau_J``, ``tau_J_d`` is what was commanded; beside ``theta``, ``theta_d`` may be its derivative.

    Args:
        names: of columns.
        alike: whether the values of two of them are, which a derivative's are not.
    """
    every = {tuple(split(name)): i for i, name in enumerate(names)}
    found = list(names)
    for i, name in enumerate(names):
        words = split(name)
        bare = tuple(word for word in words if word != "d")
        if words.count("d") == 1 and bare in every and alike(i, every[bare]):
            found[i] = " ".join("des" if word == "d" else word for word in words)
    return found


#: Words of angular velocities of a body whose angles are roll, pitch and yaw.
_BODY_RATES = _set("rate rates speed vel velocity dot")


def body_rates(names: Sequence[str], known: Sequence[str] = ()) -> list[str]:
    """Return names in which ``p``, ``q`` and ``r``, or ``roll_rate``, ``pitchspeed``, ..., are gyroscopes' axes.

    So flight logs call the angular velocities about a body's axes. Each of the three must stand once; where only some
    do, ``q`` is a position.

    Args:
        names: of columns.
        known: names of the model's objects, which they may be, too.
    """
    bare = [[w for w in _unit(split(name))[0] if not w.isdigit()] for name in names]
    found, objects = list(names), [split(name) for name in known]
    for kind, rated in ((("p", "q", "r"), False), (("roll", "pitch", "yaw"), True)):
        at = {word: [i for i, words in enumerate(bare) if _is_rate(words, word, rated=rated)] for word in kind}
        own = any(word in words if rated else words == [word] for word in kind for words in objects)
        if all(len(rows) == 1 for rows in at.values()) and not own:
            for word, axis in zip(kind, _AXES, strict=True):
                found[at[word][0]] = f"gyro {axis} {_unit_words(names[at[word][0]])}".strip()
    return found


def _is_rate(words: Sequence[str], word: str, *, rated: bool) -> bool:
    """Whether words are one alone, or one and that it is a rate, written apart or together."""
    if not rated:
        return list(words) == [word]
    rest = [w.removeprefix(word) for w in words]
    return (
        sum(w.startswith(word) for w in words) == 1 and {w for w in rest if w} < _BODY_RATES and len("".join(rest)) > 0
    )


def by_family(names: Sequence[str], known: Sequence[str]) -> list[str]:
    """Return names with a family's first word for another one: ``cam_x``, ``cam_yaw`` for ``sled_x``, ``sled_yaw``.

    Columns are so called where the rest of their names, units apart, is that of all objects of the model that have a
    first word in common, and no column has that word; where they are no numbers alone.

    Args:
        names: of columns.
        known: names of the model's objects.
    """
    families: dict[str, set[tuple[str, ...]]] = {}
    for words in {tuple(split(name)) for name in known}:
        if len(words) > 1:
            families.setdefault(words[0], set()).add(words[1:])
    families = {first: rests for first, rests in families.items() if all(any(map(str.isalpha, r)) for r in rests)}
    columns: dict[str, dict[tuple[str, ...], int]] = {}
    for i, name in enumerate(names):
        if len(words := tuple(_unit(split(name))[0])) > 1 and not _role(words[0]):
            columns.setdefault(words[0], {})[words[1:]] = i
    found = list(names)
    pairs = [
        (first, word) for first, rests in families.items() for word, own in columns.items()
        if len(rests) > 1 and own.keys() == rests and first not in columns
    ]  # fmt: skip
    times = Counter(word for pair in pairs for word in pair)
    for first, word in pairs:
        if times[first] == times[word] == 1:  # left and right legs, say, are two families of the same words
            for i in columns[word].values():
                found[i] = " ".join([first, *split(names[i])[1:]])
    return found


def _unit_words(name: str) -> str:
    every = split(name)
    return " ".join((Counter(every) - Counter(_unit(every)[0])).elements())


def actual(names: Sequence[str], words: Sequence[Words]) -> list[str]:
    """Return names without ``act`` where that says what was measured: another column has the command, or none else has
    this position or velocity, which a log of commands alone would lack.

    Args:
        names: of columns.
        words: what they say.
    """
    commanded = {
        (w.objects, w.numbers)
        for n, w in zip(names, words, strict=True)
        if w.role == "command" and _ACT not in split(n)
    }
    measured = {(w.role, w.objects, w.numbers) for w in words if w.role in ("position", "velocity", "")}
    found = []
    for name, told in zip(names, words, strict=True):
        of = told.objects, told.numbers
        alone = told.commanded in ("position", "velocity") and not {(told.commanded, *of), ("", *of)} & measured
        is_measured = _ACT in split(name) and (of in commanded or alone)
        found.append(" ".join(word for word in split(name) if word != _ACT) if is_measured else name)
    return found


def time_unit(name: str) -> float | None:
    """Return the unit of time stamps that a name tells, in seconds; ``None`` where it tells none."""
    for word in reversed([w for w in split(name) if not w.isdigit()]):
        if word in TIME_UNITS and (word not in ("sec", "secs", "seconds") or len(split(name)) > 1):
            return TIME_UNITS[word]
    return None


def _decided(roles: list[Role], commanded: Role) -> tuple[Role, Role]:
    """The role among several, the strongest first; and of what a command is one."""
    for role in ("time", "episode", "flag"):
        if roles == [role]:
            return role, ""
    if "command" in roles:
        rest: list[Role] = [r for r in ("effort", "velocity", "position") if r in roles]
        return "command", rest[0] if rest else commanded
    order: tuple[Role, ...] = (
        "other", "acceleration", "velocity", "effort", "position", "time", "episode", "flag"
    )  # fmt: skip
    return next((r for r in order if r in roles), ""), ""


def _role(word: str) -> Role:
    for role, known in _ROLES.items():
        if word in known:
            return role
    if len(word) > 3 and word.endswith("dot"):
        return "velocity"
    if word.startswith("d") and (word[1:] in _ROLES["position"] or word[1:] in _AXES):
        return "velocity"
    return ""


def _parts(word: str) -> tuple[str, ...]:
    """A word that is two, such as ``qdes`` and ``taucmd``, as these: what is commanded, and that it is."""
    if _role(word) or len(word) < 4:
        return (word,)
    for end in sorted(_ROLES["command"], key=len, reverse=True):
        begin = word.removesuffix(end)
        if len(end) > 2 and begin != word and _role(begin) in ("position", "velocity", "effort"):
            return begin, end
    return (word,)


def _short(word: str) -> tuple[str, str] | None:
    """What ``qw``, ``vx``, ``wz``, ``ax`` and ``px`` mean: kind and axis; ``None`` for other words."""
    kinds = {
        "q": "quaternion", "v": "velocity", "w": "angular", "p": "position", "d": "velocity", "a": "acceleration",
    }  # fmt: skip
    if len(word) == 2 and word[0] in kinds and (word[1] in _AXES or word == "qw"):
        return kinds[word[0]], word[1]
    if len(word) == 4 and word[1:] == "dot" and word[0] in _AXES:
        return "velocity", word[0]
    return None


def _unit(words: list[str]) -> tuple[list[str], float | None]:
    """The words without their unit, and its factor."""
    rest = list(words)
    per_time = len(rest) > 1 and rest[-1] == "s" and (rest[-2] in UNITS or rest[-2] in _LAST)
    if per_time:
        rest.pop()
    if len(rest) > 1 or per_time:
        last = rest[-1]
        if last in UNITS:
            return rest[:-1], UNITS[last]
        if last in _LAST and len(rest) > 1:
            return rest[:-1], _LAST[last]
    for i, word in enumerate(rest):
        if word in UNITS and len(rest) > 1:
            return rest[:i] + rest[i + 1 :], UNITS[word]
    return rest, None
