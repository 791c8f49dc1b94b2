"""A knock at the door before pyvisa-py goes in: that nobody is there, or hangs up within 50 ms, is known at once.

pyvisa-py 0.8 reads on from a VXI-11 connection that the other end has closed, with a whole core, until 5 s are over;
such are the ends of a tunnel to a meter that is switched off. One that hangs up later than 50 ms costs these 5 s: every
opening would have to wait for it. And pyvisa-py leaves a socket open when it cannot find the host. Nothing is said on
the connection, so a meter need not understand anything of it.
"""

import socket
from contextlib import suppress

from pyvisa.rname import InvalidResourceName, ResourceName, TCPIPInstr

from aemd.acquire.reach import door_of

__all__ = ["knock"]

HANGS_UP_WITHIN_S = 0.05  # on this computer and the LAN; each opening that succeeds takes so much longer


def knock(resource: str, timeout_s: float) -> None:
    """Find the host of a resource, and make sure that a connection to one of VXI-11 or HiSLIP is not ended at once.

    Args:
        resource: a VISA resource; of a line without a host nothing is asked.
        timeout_s: longest wait for the connection, s.

    Raises:
        InvalidResourceName: it is none, or its host or its port is nothing that a host or a port can be.
        OSError: there is no such host, or nobody listens there.
        EOFError: whoever listens hangs up within 50 ms.
    """
    try:
        _knock(resource, ResourceName.from_string(resource), timeout_s)
    except UnicodeError as error:  # the codec's: an empty or too long part of a name
        raise InvalidResourceName("no computer can be called so") from error


def _knock(resource: str, name: ResourceName, timeout_s: float) -> None:
    host = getattr(name, "host_address", "").partition(",")[0]
    if not host:
        return
    if not isinstance(name, TCPIPInstr):
        socket.getaddrinfo(host, None)
        return
    host, port = door_of(resource)
    if not (port.isascii() and port.isdigit() and 0 < int(port) < 1 << 16):
        raise InvalidResourceName(f"the port {port!r} must be 1 to 65535")
    with socket.create_connection((host, int(port)), timeout_s) as line:
        line.settimeout(HANGS_UP_WITHIN_S)
        with suppress(TimeoutError):
            if not line.recv(1):
                raise EOFError("whoever takes the connection ends it at once")
