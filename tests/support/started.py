"""Commands that tests start, and what they say."""

import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def started(*words: str | Path, cwd: Path = ROOT, **variables: str) -> subprocess.CompletedProcess[str]:
    """A command that has ended, however it did."""
    environment = {**os.environ, **variables}
    return subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


def said(*words: str | Path, cwd: Path = ROOT, status: int = 0, **variables: str) -> str:
    """What a command says on both streams, which must end with a status."""
    done = started(*words, cwd=cwd, **variables)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr
