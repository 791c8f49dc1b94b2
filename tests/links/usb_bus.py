"""A USB bus for real libusb: umockdev hands its ioctls to the simulated meter's endpoints. Run as a program:

    python tests/links/usb_bus.py CLIENT.py

CLIENT runs in a child process under umockdev's preload library, where /dev and /sys show the meter plugged in. What it
writes to its stdout on lines of their own as `plug`, `unplug` and `move SECONDS` is done here and answered by a line on
its stdin; all else is passed on. Exit code: the child's.
"""

import errno
import os
import struct
import subprocess
import sys
import time
from pathlib import Path
from threading import Thread

from sim34410 import Options, make_bench
from sim34410.usb import Stall, UsbDevice

# linux/usbdevice_fs.h, on 64 bits
SUBMIT, DISCARD, REAP, REAP_NOW = 0x8038550A, 0x550B, 0x4008550C, 0x4008550D
CLEAR_HALT, GET_CAPABILITIES, GET_DRIVER = 0x80045515, 0x8004551A, 0x41045508
URB = struct.Struct("=BB2xiI4xQiiiiiIQ")  # 56 bytes
URB_TYPE_CONTROL = 2
NO_PACKET_SIZE_LIMIT = 0x04

NODE = "/dev/bus/usb/001/{:03d}"
DEVICE = """P: /devices/usb1/1-1
N: bus/usb/001/{number:03d}
E: DEVNAME=/dev/bus/usb/001/{number:03d}
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
E: BUSNUM=001
E: DEVNUM={number:03d}
E: MAJOR=189
E: MINOR={number}
A: bConfigurationValue=1\\n
A: busnum=1\\n
A: devnum={number}\\n
A: idVendor={vendor:04x}\\n
A: idProduct={product:04x}\\n
A: speed=480\\n
H: descriptors={descriptors}
"""


class Flying:
    """One URB that the host has submitted."""

    def __init__(self, address, memory):
        self.address = address
        self.memory = memory
        (self.kind, self.endpoint, _, _, _, self.length, *_) = URB.unpack(bytes(memory.retrieve()))
        self.status = self.sent = None
        self.buffer = memory.resolve(16, self.length) if self.length else None

    @property
    def content(self):
        return bytes(self.buffer.retrieve()) if self.buffer else b""

    def finish(self, status, arrived=b"", *, at=0, sent=None):
        if arrived:
            self.buffer.update(at, list(arrived))
        self.status, self.sent = status, len(arrived) if sent is None else sent


class Bus:
    """A bus with one port."""

    def __init__(self, device, umockdev):
        self.device = device
        self._umockdev = umockdev
        self.testbed = umockdev.Testbed.new()
        self.number = 1
        self.is_plugged = False
        self.flying = []
        self.handler = None

    def plug(self):
        self.number += 1
        self.is_plugged = True
        self.flying.clear()
        descriptors = self.device.device_descriptor + self.device.configuration_descriptor
        text = DEVICE.format(
            number=self.number, vendor=self.device.vendor, product=self.device.product, descriptors=descriptors.hex()
        )
        assert self.testbed.add_from_string(text)
        self.handler = self._umockdev.IoctlBase()
        self.handler.connect("handle-ioctl", self._handle, self.number)
        self.testbed.attach_ioctl(NODE.format(self.number), self.handler)
        self.testbed.uevent("/sys/devices/usb1/1-1", "add")

    def unplug(self):
        self.is_plugged = False
        self.device.close()
        self.testbed.uevent("/sys/devices/usb1/1-1", "remove")
        self.testbed.remove_device("/sys/devices/usb1/1-1")

    def _handle(self, _, client, number):
        request, argument = client.get_request() & 0xFFFFFFFF, client.get_arg()
        try:
            self._obey(client, request, argument, number)
        except OSError as error:
            client.complete(-1, error.errno)
        return True

    def _obey(self, client, request, argument, number):
        is_there = self.is_plugged and number == self.number
        if request in (REAP, REAP_NOW):
            self._reap(client, argument, is_there)
            return
        if not is_there:
            raise OSError(errno.ENODEV, "unplugged")
        if request == SUBMIT:
            (address,) = struct.unpack("Q", bytes(argument.retrieve())[:8])
            self.flying.append(Flying(address, argument.resolve(0, URB.size)))
        elif request == DISCARD:
            (address,) = struct.unpack("Q", bytes(argument.retrieve())[:8])
            found = [urb for urb in self.flying if urb.address == address and urb.status is None]
            if not found:
                raise OSError(errno.EINVAL, "no such URB")
            found[0].finish(-errno.ENOENT)
        elif request == GET_CAPABILITIES:
            argument.resolve(0, 4).update(0, list(struct.pack("I", NO_PACKET_SIZE_LIMIT)))
        elif request == GET_DRIVER:
            raise OSError(errno.ENODATA, "no kernel driver")
        elif request == CLEAR_HALT:
            (endpoint,) = struct.unpack("I", bytes(argument.resolve(0, 4).retrieve()))
            self.device.clear_halt(endpoint)
        client.complete(0, 0)  # claim, release, set configuration...

    def _reap(self, client, argument, is_there):
        for urb in self.flying:
            if urb.status is None:
                if is_there:
                    self._transfer(urb)
                else:
                    urb.finish(-errno.ESHUTDOWN)
            if urb.status is not None:
                self.flying.remove(urb)
                urb.memory.update(4, list(struct.pack("i", urb.status)))
                urb.memory.update(28, list(struct.pack("i", urb.sent)))
                argument.resolve(0, 8).set_ptr(0, urb.memory)
                client.complete(0, 0)
                return
        raise OSError(errno.EAGAIN if is_there else errno.ENODEV, "nothing to reap")

    def _transfer(self, urb):
        try:
            if urb.kind == URB_TYPE_CONTROL:
                kind, request, value, index, length = struct.unpack_from("<BBHHH", urb.content)
                answer = self.device.control(kind, request, value, index, length)
                urb.finish(0, answer, at=8, sent=len(answer) if kind & 0x80 else length)
            elif urb.endpoint & 0x80:
                arrived = self.device.bulk_in(urb.length)
                if arrived is not None:
                    urb.finish(0, arrived)
            else:
                self.device.bulk_out(urb.content)
                urb.finish(0, sent=urb.length)
        except Stall:
            urb.finish(-errno.EPIPE)


class Jump:
    """The host's monotonic time, and a jump."""

    ahead_ns = 0

    def __call__(self):
        return time.monotonic_ns() + self.ahead_ns


def main() -> int:
    sys.path.append("/usr/lib/python3/dist-packages")  # where Debian's python3-gi is
    import gi  # noqa: PLC0415 - not every Python has it

    gi.require_version("UMockdev", "1.0")
    from gi.repository import GLib, UMockdev  # noqa: PLC0415

    clock = Jump()
    bench = make_bench(Options(noise=False), clock)
    bus = Bus(UsbDevice(bench), UMockdev)
    bus.plug()
    environment = {**os.environ, "LD_PRELOAD": "libumockdev-preload.so.0", "UMOCKDEV_DIR": bus.testbed.get_root_dir()}
    child = subprocess.Popen(
        [sys.executable, *sys.argv[1:]], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    loop = GLib.MainLoop()

    def obey(words):
        if words[0] == "move":
            clock.ahead_ns += round(float(words[1]) * 1e9)
        else:
            getattr(bus, words[0])()
        child.stdin.write("done\n")
        child.stdin.flush()
        return False

    def listen():
        for line in child.stdout:
            words = line.split()
            if words and words[0] in ("plug", "unplug", "move"):
                GLib.idle_add(obey, words)
            else:
                sys.stdout.write(line)
                sys.stdout.flush()
        GLib.idle_add(loop.quit)

    Thread(target=listen, daemon=True).start()
    loop.run()
    return child.wait()


if __name__ == "__main__":
    assert Path(sys.argv[1]).is_file()
    sys.exit(main())
