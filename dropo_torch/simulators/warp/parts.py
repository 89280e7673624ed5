"""Parts of the physics that kernels are made without where a model does not have them.

Code that is never run costs all the same: a kernel with a part takes longer to compile, and the registers that calls
take are missing elsewhere. So a model gets the kernels with its parts alone. Each part is a bit of a number that the
compiler is told; a condition on one is settled while it compiles.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from dropo_torch.simulators.warp.types import Tables

#: General collision of convex geoms.
CONVEX = 1
#: Connect and weld equalities, tendons.
COUPLINGS = 2
#: Forces of a medium, and the full slope of forces that an implicit integrator takes.
MEDIUM = 4
#: Activations of actuators, and actuators at sites.
DRIVES = 8
#: Frames and sizes that vary.
FRAMES = 16

#: Warp's hint against inlining, of which a CPU takes no notice.
_LEFT_TO_LLVM = """
#undef WP_NOINLINE
#define WP_NOINLINE
"""


def _part(bit: int) -> str:
    """Native code of a function that says whether this kernel is made with a part."""
    # each a function without arguments, whose value is known before anything is inlined
    return f"""
#ifdef DROPO_PARTS
    return (DROPO_PARTS & {bit}) != 0;
#else
    return true;
#endif
"""


@wp.func_native(_part(CONVEX))
def with_convex() -> bool:
    """Whether this kernel is made with general collision of convex geoms."""


@wp.func_native(_part(COUPLINGS))
def with_couplings() -> bool:
    """Whether this kernel is made with welds and tendons."""


@wp.func_native(_part(MEDIUM))
def with_medium() -> bool:
    """Whether this kernel is made with forces of a medium and full slopes."""


@wp.func_native(_part(DRIVES))
def with_drives() -> bool:
    """Whether this kernel is made with activations and actuators at sites."""


@wp.func_native(_part(FRAMES))
def with_frames() -> bool:
    """Whether this kernel is made with frames and sizes that vary."""


@wp.func(inline=True)
def num_tendons(m: wp.ref[Tables]) -> int:
    """Number of tendons, none where the kernel is made without."""
    n = 0
    if with_couplings():
        n = m.nten
    return n


@wp.func(inline=True)
def num_welds(m: wp.ref[Tables]) -> int:
    """Number of connect and weld equalities, none where the kernel is made without."""
    n = 0
    if with_couplings():
        n = m.nweld
    return n


@wp.func(inline=True)
def has_medium(m: wp.ref[Tables]) -> bool:
    """Whether a medium acts on the bodies."""
    return with_medium() and m.has_fluid != 0


@wp.func(inline=True)
def has_full_slope(m: wp.ref[Tables]) -> bool:
    """Whether the integrator takes a slope of forces that couples all dofs."""
    return with_medium() and m.full != 0


@wp.func(inline=True)
def num_activations(m: wp.ref[Tables]) -> int:
    """Number of activations, none where the kernel is made without."""
    n = 0
    if with_drives():
        n = m.na
    return n


@wp.func(inline=True)
def is_activated(m: wp.ref[Tables], i: int) -> bool:
    """Whether actuator ``i`` has an activation."""
    return with_drives() and m.act_state[i] >= 0


@wp.func(inline=True)
def has_thrust(m: wp.ref[Tables]) -> bool:
    """Whether there are actuators at sites."""
    return with_drives() and m.has_thrust != 0


@wp.func(inline=True)
def is_thrust(m: wp.ref[Tables], i: int) -> bool:
    """Whether actuator ``i`` is at a site."""
    return with_drives() and m.act_body[i] >= 0


@wp.func(inline=True)
def has_frames(m: wp.ref[Tables]) -> bool:
    """Whether frames of bodies or joints vary."""
    return with_frames() and m.want_frames != 0


@wp.func(inline=True)
def has_geoms(m: wp.ref[Tables]) -> bool:
    """Whether frames or sizes of geoms vary."""
    return with_frames() and m.want_geoms != 0


def make_kernel(function: Callable[..., None], parts: int, *, differentiated: bool = False) -> wp.Kernel:
    """Return the kernel of a function that has some parts, in a module of its own for each set of them.

    Args:
        function: what a thread does.
        parts: bits of the parts.
        differentiated: whether Warp derives an adjoint.
    """
    module = f"{function.__module__}.parts{parts}"
    told = f"#define DROPO_PARTS {parts}\n"
    # what says inline=False is called on a GPU, where NVIDIA's compiler would otherwise inline it everywhere; on a CPU
    # LLVM's own thresholds decide
    build = wp.ModuleBuildOptions(extra_cpu_preamble=told + _LEFT_TO_LLVM, extra_cuda_preamble=told)
    options = {"enable_backward": False, "extra_build_options": build, "cpu_compiler_flags": "-march=native"}
    wp.set_module_options(options, module=module)
    return wp.kernel(function, enable_backward=differentiated, module=module)


def parts_of(tables: Tables, *, convex: bool) -> int:
    """Return the parts that a model has, as bits; ``convex`` if it has pairs of general convex geoms."""
    found = {
        CONVEX: convex,
        COUPLINGS: tables.nten or tables.nweld,
        MEDIUM: tables.has_fluid or tables.full,
        DRIVES: tables.na or tables.has_thrust,
        FRAMES: tables.want_frames or tables.want_geoms,
    }
    return sum(part for part, has in found.items() if has)
