"""The world: scenes, renderers, the event camera, and the environment built from them."""

from pathlib import Path

from core import fix_target, forget_stale_kernels

fix_target()
forget_stale_kernels(Path(__file__).parent)
