"""One target for compiled kernels, so that a cache made once serves every machine of its class."""

import os
import sys
import sysconfig
import warnings
from pathlib import Path

# The processor's name and extra features, as LLVM calls them. An empty list means those of the name.
TARGETS = {"x86_64": ("x86-64-v3", ""), "aarch64": ("generic", "+neon"), "arm64": ("generic", "+neon")}
NAME, FEATURES = "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"
# What x86-64-v3 has and older processors lack, as Linux calls it.
X86_64_V3 = frozenset({"abm", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"})


def fix_target(processors: Path = Path("/proc/cpuinfo")) -> None:
    """Let numba compile for x86-64-v3, or for Armv8 with NEON, whatever processor this machine has.

    numba would take this processor with all its features: other machines could not load what it compiled,
    and wider vectors add in another order, where a kernel allows that. NUMBA_CPU_NAME or NUMBA_CPU_FEATURES
    of the user take precedence. Processes that this one starts inherit the choice.

    Args:
        processors: The file in which Linux describes its processors.

    Raises:
        RuntimeError: The processor is older than x86-64-v3.
    """
    machine = sysconfig.get_platform().rpartition("-")[2]
    if machine not in TARGETS or NAME in os.environ or FEATURES in os.environ:
        return
    if machine == "x86_64" and (lacking := _lacking(processors)):
        raise RuntimeError(
            f"this processor lacks {', '.join(lacking)} of x86-64-v3, for which Evade compiles; "
            f"set {NAME}=generic to compile for any x86-64 processor, which is slower"
        )
    if _has_compiled():
        warnings.warn(
            "numba compiled something before Evade was imported, and goes on to compile for this processor "
            "alone: import envs or models first",
            stacklevel=3,
        )
        return
    name, features = TARGETS[machine]
    os.environ |= {NAME: name, FEATURES: features}
    if config := sys.modules.get("numba.core.config"):  # it has read the environment already
        config.CPU_NAME, config.CPU_FEATURES = name, features  # type: ignore[attr-defined]


def _lacking(processors: Path) -> list[str]:
    """Features of x86-64-v3 that the first processor of a list lacks; none where there is no list."""
    try:
        text = processors.read_text()
    except OSError:
        return []
    flags = next((line for line in text.splitlines() if line.startswith("flags")), "")
    return sorted(X86_64_V3.difference(flags.split())) if flags else []


def _has_compiled() -> bool:
    """Whether numba has set up its compiler in this process, whose target is fixed from then on."""
    registry = sys.modules.get("numba.core.registry")
    return registry is not None and "_toplevel_target_context" in vars(registry.cpu_target)
