"""What a client does on the bus of usb_bus.py, through pyvisa-py, pyusb and real libusb; prints its findings as JSON.

First as anyone's script, then through the driver's own line. `unplug`, `plug` and `move` on stdout ask the bus.
"""

import json
import sys
import time
from importlib import import_module

import numpy as np
import pyvisa

from aemd.errors import InstrumentError
from agilent34410.link import open_link

STREAM = (
    "CONF:VOLT:DC 10;:VOLT:APER 1E-4;:VOLT:ZERO:AUTO OFF;:TRIG:DEL 0;COUN INF;"
    ":SAMP:COUN MAX;SOUR TIM;TIM 1E-4;:FORM REAL,64;:INIT;:SYST:ERR?"
)
found: dict[str, object] = {}


def ask_bus(*words: object) -> None:
    print(*words, flush=True)
    assert sys.stdin.readline() == "done\n"


def listed() -> list[str]:
    return import_module("pyvisa_py.usb").USBInstrSession.list_resources()


def as_anyone(manager: pyvisa.ResourceManager, resource: str) -> None:
    line = manager.open_resource(resource, read_termination="\n", write_termination="\n", timeout=1000)
    line.chunk_size = 1 << 20
    found["identity"] = line.query("*IDN?")
    begun_s = time.monotonic()
    try:
        line.read()
    except pyvisa.VisaIOError as error:
        found["timeout"] = error.error_code == pyvisa.constants.StatusCode.error_timeout
    found["timeout_s"] = time.monotonic() - begun_s
    found["after the timeout"] = line.query("SYST:ERR?;*IDN?")
    line.close()


def as_the_driver(resource: str) -> None:
    line = open_link(resource, timeout_s=1.0)
    line.query(STREAM)
    values_V = []
    for _ in range(5):
        ask_bus("move", 2.0)
        count = int(line.query("DATA:POIN?"))
        content, _ = line.query_block(f"R? {count}", 8 * count)
        values_V.append(np.frombuffer(content, ">f8"))
    found["readings"] = sum(part.size for part in values_V)
    found["overflow or violation"] = line.query("STAT:QUES:EVEN?")
    found["finite"] = bool(np.isfinite(np.concatenate(values_V)).all())
    line.write("*IDN?")
    line.clear()
    found["after the clear"] = line.query("SYST:VERS?")
    ask_bus("unplug")
    try:
        line.query("*IDN?")
    except InstrumentError as error:
        found["unplugged"] = str(error)
    line.close()
    try:
        open_link(resource, timeout_s=1.0)
    except InstrumentError as error:
        found["while it is gone"] = str(error)
    ask_bus("plug")
    found["listed again"] = listed()
    line = open_link(resource, timeout_s=1.0)
    found["plugged in again"] = line.query("*IDN?")
    line.close()


def main() -> None:
    manager = pyvisa.ResourceManager("@py")
    found["listed"] = listed()
    resource = "USB0::0x0957::0x0607::MY47006594::INSTR"
    as_anyone(manager, resource)
    as_the_driver(resource)
    print(json.dumps(found), flush=True)
    manager.close()


if __name__ == "__main__":
    main()
