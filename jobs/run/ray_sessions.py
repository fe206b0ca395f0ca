"""Delete the folders of local Rays that have ended, except the newest, which are left for their logs."""

import shutil
import socket
from pathlib import Path

KEPT = 10  # newest ended sessions; a few MB each


def forget_sessions(folder: Path) -> None:
    """Delete the folders of ended sessions; of the newest `KEPT` sessions delete only the sockets.

    Args:
        folder: Folder of the local Rays' sessions, see `jobs.run.ray_cluster.ray_folder`; no Ray may be
            starting in it.
    """
    sessions = [path for path in folder.glob("ray/session_*") if path.is_dir() and not path.is_symlink()]
    ended = sorted((path for path in sessions if not serves(path)), reverse=True)  # names begin with the time
    for session in ended[:KEPT]:
        shutil.rmtree(session / "sockets", ignore_errors=True)
    for session in ended[KEPT:]:
        shutil.rmtree(session, ignore_errors=True)


def serves(session: Path) -> bool:
    """Whether the Ray of a session still runs: its store accepts connections, also across containers."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(1.0)
        try:
            client.connect(str(session / "sockets" / "plasma_store"))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            return True  # it runs, but does not answer now
    return True
