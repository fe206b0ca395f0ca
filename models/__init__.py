"""From events to actions: embedding, event VAE, lookup table, encoder files, policies."""

from pathlib import Path

from core import fix_target, forget_stale_kernels

fix_target()
forget_stale_kernels(Path(__file__).parent)
