"""Install pinned packages into the environment of this Python: python platform/install.py LOCK ...

uv needs less than half of pip's work, and installs torch without CUDA's libraries if there is no GPU. pip is
used if uv is not available, fails, or does not support one of pip's settings on this machine.
"""

import ast
import os
import subprocess
import sys
from collections.abc import Mapping

UV = "uv==0.13.9"
# pip's settings, and the variables of uv for the same settings.
SAME = {
    "cert": "SSL_CERT_FILE",
    "constraint": "UV_CONSTRAINT",
    "default-timeout": "UV_HTTP_TIMEOUT",
    "extra-index-url": "UV_EXTRA_INDEX_URL",
    "find-links": "UV_FIND_LINKS",
    "index-url": "UV_DEFAULT_INDEX",
    "timeout": "UV_HTTP_TIMEOUT",
}
PLACES = {"find-links", "index-url", "extra-index-url"}  # if one is set, it says where torch comes from
# pip's settings that do not affect what is installed.
WITHOUT_EFFECT = {
    *("break-system-packages", "disable-pip-version-check", "no-cache-dir", "no-compile", "no-input"),
    *("progress-bar", "quiet", "require-virtualenv", "retries", "root-user-action", "verbose"),
}


def main(locks: list[str]) -> int:
    """Install the packages, and return the exit status of the installer."""
    files = [word for lock in locks for word in ("--requirement", lock)]
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    settings = uv_settings(pip_settings())
    if settings is not None and subprocess.run([*pip, UV], check=False).returncode == 0:
        uv = [sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", sys.executable]
        if subprocess.run([*uv, *files], env=settings | os.environ, check=False).returncode == 0:
            return 0
        print("uv has failed; pip goes on", file=sys.stderr)
    return subprocess.run([*pip, "--no-compile", *files], check=False).returncode


def pip_settings() -> dict[str, str]:
    """Return pip's settings from files and variables; a later one overrides an earlier one."""
    command = [sys.executable, "-m", "pip", "config", "list", "--disable-pip-version-check"]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    pairs = [line.partition(".")[2].partition("=") for line in lines]
    return {key: str(ast.literal_eval(value)) for key, _, value in pairs}


def uv_settings(settings: Mapping[str, str]) -> dict[str, str] | None:
    """Return the variables with which uv installs the same packages as pip; None if there are none.

    Args:
        settings: Names and values as `pip config list` prints them.
    """
    if settings.keys() - SAME.keys() - WITHOUT_EFFECT:
        return None
    same = {SAME[key]: value for key, value in settings.items() if key in SAME}
    if "UV_FIND_LINKS" in same:
        same["UV_FIND_LINKS"] = ",".join(same["UV_FIND_LINKS"].split())
    if settings.keys().isdisjoint(PLACES):
        same["UV_TORCH_BACKEND"] = "auto"  # CUDA's libraries only where there is a GPU
    return same | {"UV_INDEX_STRATEGY": "unsafe-best-match"}  # like pip: the best version from all places


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
