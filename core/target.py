"""Compile kernels for one fixed target, so that one cache serves every machine of that class."""

import os
import sys
import sysconfig
import warnings
from pathlib import Path

# Processor name and extra features in LLVM's spelling. Without extra features the name implies all of them.
TARGETS = {"x86_64": ("x86-64-v3", ""), "aarch64": ("generic", "+neon"), "arm64": ("generic", "+neon")}
NAME, FEATURES = "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"
# Features that x86-64-v3 adds, in Linux's spelling.
X86_64_V3 = frozenset({"abm", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"})


def fix_target(processors: Path = Path("/proc/cpuinfo")) -> None:
    """Make numba compile for x86-64-v3, or for Armv8 with NEON, whatever processor this machine has.

    By default numba uses all features of this processor. Other machines could then not load the kernels, and
    wider vectors would change the order of sums in kernels that allow it. NUMBA_CPU_NAME and
    NUMBA_CPU_FEATURES take precedence if the user sets one. Child processes inherit the choice.

    Args:
        processors: The file in which Linux lists the processors.

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
    """Return the features of x86-64-v3 that the first listed processor lacks; empty if there is no list."""
    try:
        text = processors.read_text()
    except OSError:
        return []
    flags = next((line for line in text.splitlines() if line.startswith("flags")), "")
    return sorted(X86_64_V3.difference(flags.split())) if flags else []


def _has_compiled() -> bool:
    """Whether numba has already set up its compiler in this process, which fixes the target."""
    registry = sys.modules.get("numba.core.registry")
    return registry is not None and "_toplevel_target_context" in vars(registry.cpu_target)
