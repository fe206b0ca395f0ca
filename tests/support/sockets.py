"""The sockets on which a program waits for others."""

import importlib
from ipaddress import ip_address
from socket import SOCK_DGRAM


def listening(pid: int) -> set[tuple[str, str, int]]:
    """Program, address and port of each socket that a process or one of its descendants listens on."""
    importlib.import_module("ray")  # has the only copy of psutil
    import psutil

    root = psutil.Process(pid)
    return {
        (process.name(), address.ip, address.port)
        for process in [root, *root.children(recursive=True)]
        for _, _, kind, address, _, status in process.net_connections("inet")
        if status == psutil.CONN_LISTEN or kind == SOCK_DGRAM
    }


def beyond_loopback(sockets: set[tuple[str, str, int]]) -> list[tuple[str, str, int]]:
    """Those of `listening` that another machine could reach."""
    return sorted(entry for entry in sockets if not _is_loopback(entry[1]))


def check_ray(sockets: set[tuple[str, str, int]]) -> None:
    """Ray and its workers are among those of `listening`, and all of them on loopback."""
    programs = {name for name, _, _ in sockets}
    assert {"gcs_server", "raylet"} <= programs, sockets
    assert any(name.startswith("ray::") for name in programs), sockets
    assert beyond_loopback(sockets) == []


def _is_loopback(address: str) -> bool:
    found = ip_address(address)
    return (getattr(found, "ipv4_mapped", None) or found).is_loopback
