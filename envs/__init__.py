"""The world: scenes, renderers, the event camera, and the environment made of them."""

from pathlib import Path

from native import fix_target, forget_stale_kernels

fix_target()
forget_stale_kernels(Path(__file__).parent)
