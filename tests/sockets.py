"""What a process and those that it started listen on, native programs among them, as the system's tables say."""

import ipaddress
import socket

import psutil


def listening() -> list[str]:
    """Return the addresses, "IP port", where this process and its descendants take connections or datagrams."""
    found = set[str]()
    me = psutil.Process()
    for process in (me, *me.children(recursive=True)):
        try:
            open_ = process.net_connections("inet")
        except psutil.Error:  # it has ended, and takes none
            continue
        for one in open_:
            if one.status == psutil.CONN_LISTEN or (one.type == socket.SOCK_DGRAM and one.laddr and not one.raddr):
                found.add(f"{one.laddr.ip} {one.laddr.port}")
    return sorted(found)


def beyond_loopback(addresses: list[str]) -> list[str]:
    """Return those of the addresses that others than this machine reach."""
    return [one for one in addresses if not ipaddress.ip_address(one.split()[0]).is_loopback]
