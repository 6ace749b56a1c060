"""Compile every kernel, or load it from the cache, before the first scan needs it."""

from importlib import import_module

MIRROR = ("backend.numerics.screen_phase", "backend.numerics.slope_integration")
"""What a mirror's processing needs."""

MODULES = (
    "backend.numerics.absolute_phase",
    "backend.numerics.phasors",
    "backend.numerics.gray_code",
    "backend.numerics.edges",
    "backend.numerics.line_shift",
    "backend.numerics.mixed_light",
    "backend.numerics.edge_positions",
    "backend.numerics.second_camera",
    "backend.numerics.warm_up_geometry",
    "backend.numerics.gathering",
    *MIRROR,
)
"""Modules with kernels: each has a function `warm_up_kernels()` that runs them on tiny arrays."""


def warm_up(modules: tuple[str, ...] = MODULES) -> None:
    """Run every kernel once on tiny arrays; one compilation serves uint8 and uint16 frames.

    Takes minutes where nothing is compiled yet, a second or two from the cache; call it in a thread
    of its own: kernels release the GIL.
    """
    for name in modules:
        import_module(name).warm_up_kernels()
