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
PORT_MAPPER, HISLIP = "111", "4880"


def knock(resource: str, timeout_s: float) -> None:
    """Find the host of a resource, and make sure that a connection to one of VXI-11 or HiSLIP stays.

    Args:
        resource: a VISA resource; of a line without a host nothing is asked.
        timeout_s: longest wait for the connection, s.

    Raises:
        InvalidResourceName: it is none, or its host or its port is nothing that a host or a port can be.
        OSError: there is no such host, or nobody listens there.
        EOFError: whoever listens hangs up.
    """
    try:
        _knock(ResourceName.from_string(resource), timeout_s)
    except UnicodeError as error:  # the codec's: an empty or too long part of a name
        raise InvalidResourceName("no computer can be called so") from error


def _knock(name: ResourceName, timeout_s: float) -> None:
    host, _, port = getattr(name, "host_address", "").partition(",")
    if not host:
        return
    if not isinstance(name, TCPIPInstr):
        socket.getaddrinfo(host, None)
        return
    device, _, its_port = name.lan_device_name.lower().partition(",")
    port = port or its_port or (HISLIP if device.startswith("hislip") else PORT_MAPPER)
    if not (port.isascii() and port.isdigit() and 0 < int(port) < 1 << 16):
        raise InvalidResourceName(f"the port {port!r} must be 1 to 65535")
    with socket.create_connection((host, int(port)), timeout_s) as line:
        line.settimeout(HANGS_UP_WITHIN_S)
        with suppress(TimeoutError):
            if not line.recv(1):
                raise EOFError("whoever takes the connection ends it at once")
