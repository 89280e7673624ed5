"""Systems that the speed of the Warp backend is measured on, rich in contacts: each an MJCF text."""

from __future__ import annotations

OPTION = '<option timestep="0.004" integrator="implicitfast" cone="elliptic"/>'
FLOOR = '<geom name="floor" type="plane" size="5 5 1" friction=".8 .01 .001"/>'


def _mjcf(bodies: str, motors: str, extra: str = "", option: str = OPTION) -> str:
    return f"<mujoco>{option}<worldbody>{FLOOR}{bodies}</worldbody><actuator>{motors}</actuator>{extra}</mujoco>"


def _motors(joints: list[str], gear: float) -> str:
    return "".join(f'<motor joint="{joint}" gear="{gear}" ctrlrange="-1 1" ctrllimited="true"/>' for joint in joints)


def ant() -> str:
    """Return a ball on four legs of two hinges each: 14 dofs, capsules on a plane."""
    legs, joints = "", []
    for k, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        legs += f"""<body pos="{0.2 * x} {0.2 * y} 0"><joint name="hip{k}" axis="0 0 1" range="-30 30" damping="1"
 armature=".1"/><geom type="capsule" fromto="0 0 0 {0.2 * x} {0.2 * y} 0" size=".08"/>
<body pos="{0.2 * x} {0.2 * y} 0"><joint name="knee{k}" axis="{-y} {x} 0" range="-20 60" damping="1" armature=".1"/>
<geom type="capsule" fromto="0 0 0 {0.3 * x} {0.3 * y} -.35" size=".08"/></body></body>"""
        joints += [f"hip{k}", f"knee{k}"]
    body = f'<body name="torso" pos="0 0 .5"><freejoint/><geom size=".25" density="200"/>{legs}</body>'
    return _mjcf(body, _motors(joints, 20), option='<option timestep="0.004" integrator="RK4"/>')


def _limb(name: str, pos: str, axes: str, ends: tuple[str, str], size: float, foot: str = "") -> str:
    """A limb of two capsules: joints about ``axes`` at its root, a hinge between the two."""
    roots = "".join(
        f'<joint name="{name}{i}" axis="{axis}" range="-60 60" damping="2" armature=".02" stiffness="5"/>'
        for i, axis in enumerate(axes.split(";"))
    )
    lower = f"""<body pos="{ends[0]}"><joint name="{name}bend" axis="0 1 0" range="-5 120" damping="1" armature=".01"/>
<geom type="capsule" fromto="0 0 0 {ends[1]}" size="{0.8 * size}"/>{foot}</body>"""
    return f'<body pos="{pos}">{roots}<geom type="capsule" fromto="0 0 0 {ends[0]}" size="{size}"/>{lower}</body>'


def humanoid() -> str:
    """Return a trunk with head, arms and legs: 23 dofs, capsules and spheres that also touch each other."""
    limbs, joints = "", []
    for side, y in (("left", 0.1), ("right", -0.1)):
        feet = '<geom type="capsule" fromto="-.03 .02 -.42 .14 .02 -.42" size=".03"/>'
        limbs += _limb(f"{side}hip", f"0 {y} -.1", "1 0 0;0 0 1;0 1 0", ("0 0 -.4", "0 0 -.4"), 0.06, feet)
        limbs += _limb(f"{side}arm", f"0 {2 * y} .35", "1 0 0;0 1 0", ("0 0 -.28", ".2 0 -.15"), 0.04)
        joints += [f"{side}hip{i}" for i in (0, 1, 2, "bend")] + [f"{side}arm{i}" for i in (0, 1, "bend")]
    waist = "".join(
        f'<joint name="waist{i}" axis="{a}" range="-40 40" damping="5" stiffness="20"/>'
        for i, a in enumerate(("1 0 0", "0 1 0", "0 0 1"))
    )
    chest = f"""<body pos="0 0 .1">{waist}<geom type="capsule" fromto="0 -.1 .25 0 .1 .25" size=".08"/>
<geom size=".1" pos="0 0 .5"/></body>"""
    body = f"""<body name="torso" pos="0 0 1.03"><freejoint/><geom type="capsule" fromto="0 -.08 0 0 .08 0" size=".1"/>
{chest}{limbs}</body>"""
    return _mjcf(body, _motors([*joints, "waist0", "waist1", "waist2"], 30))


def arm() -> str:
    """Return an arm of seven hinges with two fingers of boxes, and a box on a table of a box: 15 dofs."""
    lengths, axes = (0.33, 0.0, 0.32, 0.08, 0.38, 0.0, 0.09), ("0 0 1", "0 1 0") * 3 + ("0 0 1",)
    inner = """<body name="palm" pos="0 0 .1"><geom type="box" size=".04 .1 .03"/>
<body pos="0 .03 .08"><joint name="finger0" type="slide" axis="0 1 0" range="-.03 .04" damping="5"/>
<geom type="box" size=".012 .008 .05" friction="1 .05 .01"/></body><body pos="0 -.03 .08">
<joint name="finger1" type="slide" axis="0 -1 0" range="-.03 .04" damping="5"/>
<geom type="box" size=".012 .008 .05" friction="1 .05 .01"/></body></body>"""
    for k in reversed(range(7)):
        turn = ' euler="180 0 0"' if k == 5 else ""
        inner = f"""<body pos="{0.08 * (k == 3)} 0 {lengths[k]}"{turn}><joint name="joint{k}" axis="{axes[k]}"
 damping="4" armature=".1" range="-170 170"/><geom type="capsule" fromto="0 0 0 0 0 {max(lengths[(k + 1) % 7], 0.05)}"
 size=".05" contype="0" conaffinity="0"/>{inner}</body>"""
    table = '<geom name="table" type="box" size=".3 .4 .1" pos=".55 0 .1"/>'
    thing = """<body name="box" pos=".5 0 .225"><freejoint/><geom name="box" type="box" size=".03 .025 .025"
 density="400"/></body>"""
    motors = _motors([f"joint{k}" for k in range(7)], 40) + _motors(["finger0", "finger1"], 20)
    return _mjcf(
        table + thing + f'<body pos="0 0 0">{inner}</body>', motors, option=OPTION.replace("implicitfast", "Euler")
    )


def hand() -> str:
    """Return a palm with five fingers of four hinges under a box: 26 dofs, capsules and boxes."""
    fingers, joints = "", []
    for k in range(5):
        inner = ""
        for i in reversed(range(4)):
            axis = "1 0 0" if i == 0 else "0 -1 0"
            length = 0.01 if i == 0 else 0.035
            joints.append(f"finger{k}{i}")
            inner = f"""<body pos="{0.0 if i == 0 else (0.01 if i == 1 else 0.035)} 0 0"><joint name="finger{k}{i}"
 axis="{axis}" range="{-15 if i == 0 else -5} {15 if i == 0 else 90}" damping=".05" armature=".002"/>
<geom type="capsule" fromto="0 0 0 {length} 0 0" size=".009"/>{inner}</body>"""
        fingers += f'<body pos=".06 {0.025 * (k - 2)} .22">{inner}</body>'
    palm = f'<geom type="box" size=".055 .06 .012" pos="0 0 .22"/>{fingers}'
    thing = """<body name="box" pos=".05 0 .255"><freejoint/><geom name="box" type="box" size=".03 .03 .02"
 density="300" condim="4"/></body>"""
    return _mjcf(palm + thing, _motors(joints, 0.3), option=OPTION.replace("implicitfast", "Euler"))


#: Name → MJCF.
MODELS = {"ant": ant, "humanoid": humanoid, "arm": arm, "hand": hand}
