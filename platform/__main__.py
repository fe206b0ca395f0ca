"""`python -m platform` prints what the standard library's own module prints."""

import platform
import runpy

runpy.run_path(platform.__file__, run_name="__main__")
