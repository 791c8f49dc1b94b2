"""A knock at the door before pyvisa-py goes in: that nobody is there, or hangs up, is known at once.

pyvisa-py 0.8 reads on from a VXI-11 connection that the other end has closed, with a whole core, until 5 s are over;
such are the ends of a tunnel to a meter that is switched off. And it leaves a socket open when it cannot find the host.
Nothing is said on the connection, so a meter need not understand anything of it.
"""

import socket
from contextlib import suppress

from pyvisa.rname import InvalidResourceName, ResourceName, TCPIPInstr

__all__ = ["knock"]

HANGS_UP_WITHIN_S = 0.05
PORT_MAPPER = 111


def knock(resource: str, timeout_s: float) -> None:
    """Find the host of a resource, and of a VXI-11 one make sure that a connection to it stays.

    Args:
        resource: a VISA resource; of a line without a host nothing is asked.
        timeout_s: longest wait for the connection, s.

    Raises:
        InvalidResourceName: it is none, or its port is not a number that a port can have.
        OSError: there is no such host, or nobody listens there.
        EOFError: whoever listens hangs up.
    """
    name = ResourceName.from_string(resource)
    host, _, port = getattr(name, "host_address", "").partition(",")
    if not host:
        return
    if port and not (port.isascii() and port.isdigit() and 0 < int(port) < 1 << 16):
        raise InvalidResourceName(f"the port {port!r} must be 1 to 65535")
    if not isinstance(name, TCPIPInstr) or name.lan_device_name.lower().startswith("hislip"):
        socket.getaddrinfo(host, None)
        return
    with socket.create_connection((host, int(port or PORT_MAPPER)), timeout_s) as line:
        line.settimeout(HANGS_UP_WITHIN_S)
        with suppress(TimeoutError):
            if not line.recv(1):
                raise EOFError("whoever takes the connection ends it at once")
