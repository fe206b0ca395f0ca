"""Folders of local Rays that have ended: the newest stay for their logs, older ones are deleted."""

import shutil
import socket
from pathlib import Path

KEPT = 10  # of those that have ended; a few MB each


def forget_sessions(folder: Path) -> None:
    """Delete the folders of all but the newest `KEPT` sessions that have ended, and the sockets of these.

    Args:
        folder: Where a local Ray keeps its sessions, see `jobs.run.ray_cluster.ray_folder`; no Ray may
            be starting in it.
    """
    sessions = [path for path in folder.glob("ray/session_*") if path.is_dir() and not path.is_symlink()]
    ended = sorted((path for path in sessions if not serves(path)), reverse=True)  # names begin with the time
    for session in ended[:KEPT]:
        shutil.rmtree(session / "sockets", ignore_errors=True)
    for session in ended[KEPT:]:
        shutil.rmtree(session, ignore_errors=True)


def serves(session: Path) -> bool:
    """Whether the Ray of a session still runs: its store takes connections, also of other containers."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(1.0)
        try:
            client.connect(str(session / "sockets" / "plasma_store"))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            return True  # it does not answer now
    return True
