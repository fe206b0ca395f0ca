"""Jobs: what spends the compute and writes down what happened. Importing this starts nothing."""

import importlib.util
import sys
from pathlib import Path


def main() -> int:
    """Run the command `evade`: the launcher of `python -m platform.launch`, from any folder.

    The launcher is loaded from its file beside this package, because outside the repository
    root `platform` is the standard library's module.
    """
    launcher = Path(__file__).resolve().parent.parent / "platform" / "launch.py"
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
