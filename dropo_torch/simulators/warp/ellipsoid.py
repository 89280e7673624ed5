"""Forces of the medium on a geom as on an ellipsoid (``fluidshape``): drag, lift and added mass, and their slopes."""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.spatial import at, join, theta_vec3
from dropo_torch.simulators.warp.types import HALF, MINVAL, TWO, ZERO, Tables, World, f64, mat33, vec3, vec6

PI = wp.constant(wp.float64(wp.pi))
TINY = wp.constant(wp.float64(1.0e-30))  # keeps the slope of a root finite at rest


@wp.func(inline=False)
def _middle(size: vec3) -> f64:
    """The semi-axis between the largest and the smallest."""
    return size[0] + size[1] + size[2] - wp.max(size) - wp.min(size)


@wp.func(inline=False)
def _section(size: vec3) -> vec3:
    """(b c)², (c a)², (a b)²: squares of the areas that the semi-axes see, over π²."""
    return vec3(
        size[1] * size[1] * size[2] * size[2],
        size[2] * size[2] * size[0] * size[0],
        size[0] * size[0] * size[1] * size[1],
    )


@wp.func(inline=False)
def _moment(along: f64, one: f64, other: f64) -> f64:
    """Moment of the largest spheroid that turns about a semi-axis."""
    wide = wp.max(one, other)
    return f64(8.0) / f64(15.0) * PI * along * wide * wide * wide * wide


@wp.func(inline=False)
def _turning_drag(size: vec3, drag: vec3) -> vec3:
    """Coefficients of the quadratic drag on each component of the angular velocity."""
    long = wp.max(size)
    largest = f64(8.0) / f64(15.0) * PI * _middle(size) * long * long * long * long
    own = vec3(
        _moment(size[0], size[1], size[2]), _moment(size[1], size[2], size[0]), _moment(size[2], size[0], size[1])
    )
    return own * drag[2] + (vec3(largest, largest, largest) - own) * drag[1]


@wp.func(inline=False)
def ellipsoid_force(w: vec3, v: vec3, size: vec3, drag: vec3, lift: vec3, mass: vec3, density: f64, viscosity: f64):
    """Force in the geom's frame as it moves at ``v`` through the medium and turns at ``w``.

    ``drag`` are the coefficients of blunt, slender and angular drag, ``lift`` those of Kutta's and Magnus' lift,
    ``mass`` is the added mass along the axes, of a medium with density 1.
    """
    section = _section(size)
    vv = wp.cw_mul(v, v)
    denom = wp.dot(wp.cw_mul(section, section), vv)
    num = wp.dot(section, vv)
    speed = wp.length(v)
    diameter = TWO / f64(3.0) * (size[0] + size[1] + size[2])
    projected = PI * wp.sqrt(wp.max(TINY, denom / wp.max(MINVAL, num)))
    largest = PI * wp.max(size) * _middle(size)
    k = viscosity * f64(3.0) * PI * diameter + density * speed * (projected * drag[0] + drag[1] * (largest - projected))
    cosine = num / wp.max(MINVAL, speed * denom)
    circulation = wp.cross(wp.cw_mul(section, v), v) * (lift[0] * density * cosine * projected)
    volume = f64(4.0) / f64(3.0) * PI * size[0] * size[1] * size[2]
    magnus = wp.cross(w, v) * (lift[1] * density * volume)
    added = wp.cross(wp.cw_mul(mass, v) * density, w)
    return magnus + wp.cross(circulation, v) - v * k + added


@wp.func(inline=False)
def ellipsoid_torque(
    w: vec3, v: vec3, size: vec3, drag: vec3, mass: vec3, inertia: vec3, density: f64, viscosity: f64
) -> vec3:
    """Torque in the geom's frame; ``inertia`` is the added one about the axes, of a medium with density 1."""
    diameter = TWO / f64(3.0) * (size[0] + size[1] + size[2])
    quadratic = wp.length(wp.cw_mul(_turning_drag(size, drag), w))
    k = viscosity * PI * diameter * diameter * diameter + density * quadratic
    added = wp.cross(wp.cw_mul(mass, v), v) + wp.cross(wp.cw_mul(inertia, w), w)
    return added * density - w * k


@wp.func(inline=False)
def ellipsoid_power(
    w: vec3, v: vec3, lw: vec3, lv: vec3, size: vec3, drag: vec3, lift: vec3, mass: vec3, inertia: vec3, density: f64,
    viscosity: f64,
) -> f64:  # fmt: skip
    """−(force · lv + torque · lw): what the medium adds to λᵀR, all in the geom's frame."""
    return (
        ZERO
        - wp.dot(ellipsoid_force(w, v, size, drag, lift, mass, density, viscosity), lv)
        - wp.dot(ellipsoid_torque(w, v, size, drag, mass, inertia, density, viscosity), lw)
    )


@wp.func(inline=True)
def fluid_frame(m: wp.ref[Tables], w: wp.ref[World], b: int, g: int) -> mat33:
    """Rotation of geom ``g`` of body ``b``."""
    return w.xmat[w.t, b] * m.geom_mat[g]


@wp.func(inline=True)
def fluid_center(m: wp.ref[Tables], w: wp.ref[World], b: int, g: int) -> vec3:
    """Center of geom ``g`` of body ``b``, from the origin of the sweep."""
    return w.xpos[w.t, b] + w.xmat[w.t, b] * m.geom_pos[g]


@wp.func(inline=False)
def ellipsoids_wrench(m: wp.ref[Tables], w: wp.ref[World], b: int) -> vec6:
    """The medium's forces on the geoms of body ``b`` that are taken as ellipsoids, as a spatial force."""
    total = vec6()
    density = w.th[m.o_density]
    viscosity = w.th[m.o_viscosity]
    vel = w.velocity[w.t, b]
    first = m.body_fluid[b]
    for i in range(first, first + m.body_nfluid[b]):
        g = m.fluid_geom[i]
        rot = fluid_frame(m, w, b, g)
        c = fluid_center(m, w, b, g)
        back = wp.transpose(rot)
        turn = back * wp.spatial_top(vel)
        move = back * (at(vel, c) - theta_vec3(w.th, m.o_wind))
        drag = m.fluid_drag[i]
        mass = m.fluid_mass[i]
        size = m.fluid_size[i]
        f = rot * ellipsoid_force(turn, move, size, drag, m.fluid_lift[i], mass, density, viscosity)
        n = rot * ellipsoid_torque(turn, move, size, drag, mass, m.fluid_inertia[i], density, viscosity)
        total += join(wp.cross(c, f) + n, f)
    return total


@wp.func(inline=False)
def _force_slope(
    w: vec3, v: vec3, uw: vec3, uv: vec3, size: vec3, drag: vec3, lift: vec3, mass: vec3, density: f64, viscosity: f64
) -> vec3:
    """Slope of :func:`ellipsoid_force` along (uw, uv), bounded near rest as in MuJoCo."""
    section = _section(size)
    square = wp.cw_mul(section, section)
    vv = wp.cw_mul(v, v)
    denom = wp.dot(square, vv)
    num = wp.dot(section, vv)
    dot = wp.dot(v, uv)
    ddenom = wp.dot(wp.cw_mul(square, v), uv)  # halves of both slopes
    dnum = wp.dot(wp.cw_mul(section, v), uv)
    speed = wp.length(v)
    diameter = TWO / f64(3.0) * (size[0] + size[1] + size[2])
    projected = PI * wp.sqrt(wp.max(TINY, denom / wp.max(MINVAL, num)))
    dprojected = PI * (num * ddenom - denom * dnum) / wp.sqrt(wp.max(TINY, num * num * num * denom))
    largest = PI * wp.max(size) * _middle(size)
    area = projected * drag[0] + drag[1] * (largest - projected)
    k = viscosity * f64(3.0) * PI * diameter + density * speed * area
    dk = density * (dot / wp.max(MINVAL, speed) * area + speed * (drag[0] - drag[1]) * dprojected)
    g = PI * lift[0] * density / wp.sqrt(wp.max(TINY, denom * num * speed * speed))
    sv = wp.cw_mul(section, v)
    q = v * num - sv * wp.dot(v, v)
    dq = uv * num + v * (TWO * dnum) - wp.cw_mul(section, uv) * wp.dot(v, v) - sv * (TWO * dot)
    turned = dnum - num / wp.max(MINVAL, denom) * ddenom - num / wp.max(MINVAL, wp.dot(v, v)) * dot
    volume = f64(4.0) / f64(3.0) * PI * size[0] * size[1] * size[2]
    magnus = (wp.cross(uw, v) + wp.cross(w, uv)) * (lift[1] * density * volume)
    added = (wp.cross(wp.cw_mul(mass, uv), w) + wp.cross(wp.cw_mul(mass, v), uw)) * density
    return magnus + (dq * num + q * turned) * g - uv * k - v * dk + added


@wp.func(inline=False)
def _torque_slope(
    w: vec3,
    v: vec3,
    uw: vec3,
    uv: vec3,
    size: vec3,
    drag: vec3,
    mass: vec3,
    inertia: vec3,
    density: f64,
    viscosity: f64,
) -> vec3:
    """Slope of :func:`ellipsoid_torque` along (uw, uv)."""
    diameter = TWO / f64(3.0) * (size[0] + size[1] + size[2])
    coefficients = _turning_drag(size, drag)
    moment = wp.cw_mul(coefficients, w)
    quadratic = wp.length(moment)
    k = viscosity * PI * diameter * diameter * diameter + density * quadratic
    dk = density * wp.dot(moment, wp.cw_mul(coefficients, uw)) / wp.max(MINVAL, quadratic)
    added = (
        wp.cross(wp.cw_mul(mass, uv), v)
        + wp.cross(wp.cw_mul(mass, v), uv)
        + wp.cross(wp.cw_mul(inertia, uw), w)
        + wp.cross(wp.cw_mul(inertia, w), uw)
    )
    return added * density - uw * k - w * dk


@wp.func(inline=False)
def ellipsoid_slope(
    w: vec3, v: vec3, uw: vec3, uv: vec3, size: vec3, drag: vec3, lift: vec3, mass: vec3, inertia: vec3, density: f64,
    viscosity: f64,
) -> vec6:  # fmt: skip
    """Slope of torque and force along (uw, uv)."""
    return join(
        _torque_slope(w, v, uw, uv, size, drag, mass, inertia, density, viscosity),
        _force_slope(w, v, uw, uv, size, drag, lift, mass, density, viscosity),
    )


@wp.func(inline=False)
def ellipsoid_slope_power(
    w: vec3, v: vec3, lw: vec3, lv: vec3, uw: vec3, uv: vec3, size: vec3, drag: vec3, lift: vec3, mass: vec3,
    inertia: vec3, density: f64, viscosity: f64, symmetric: int,
) -> f64:  # fmt: skip
    """−λᵀ (slope along u), or its symmetric part in λ and u."""
    one = wp.dot(ellipsoid_slope(w, v, uw, uv, size, drag, lift, mass, inertia, density, viscosity), join(lw, lv))
    other = wp.dot(ellipsoid_slope(w, v, lw, lv, size, drag, lift, mass, inertia, density, viscosity), join(uw, uv))
    return wp.where(symmetric != 0, -HALF * (one + other), -one)
