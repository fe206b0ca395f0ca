"""The commands that train, evaluate and measure. Importing this package starts nothing."""

import importlib.util
import sys
from pathlib import Path


def main() -> int:
    """Run the command `evade`: the launcher of `python -m platform.launch`, from any folder.

    The launcher is loaded from its file, because outside the repository root `platform` is the standard
    library's module. It lies next to this package, or in the data folder of an installed wheel.
    """
    homes = Path(__file__).resolve().parent.parent, Path(sys.prefix) / "share" / "evade"
    launcher = next((home for home in homes if (home / "conf").is_dir()), homes[0]) / "platform" / "launch.py"
    spec = importlib.util.spec_from_file_location("evade_launch", launcher)
    if spec is None or spec.loader is None or not launcher.is_file():
        print(
            f"evade: the launcher is not at {str(launcher)!r}; install from a clone of the repository "
            "with `pip install -e .`",
            file=sys.stderr,
        )
        return 2
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main()


def demo() -> int:
    """Run the command `demo`, which is `evade demo`."""
    sys.argv[:1] = [str(Path(sys.argv[0]).with_name("evade")), "demo"]
    return main()
