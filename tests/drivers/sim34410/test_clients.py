"""Clients that others wrote read a voltage from the simulated meter over its socket."""

import socket

import numpy as np
import pytest

from aemd.model import Level
from sim34410 import Options, make_bench, serve
from tests.drivers.sim34410.links import served

LEVEL_V = 1.2345


@pytest.fixture
def resource():
    with serve(Options(terms=(Level(level_V=LEVEL_V),), noise=False), "127.0.0.1", 0) as resource:
        yield resource


@pytest.mark.parametrize("link", ["socket", "vxi11", "usb"])
def test_pymeasure_reads_a_voltage(link):
    agilent = pytest.importorskip("pymeasure.instruments.agilent", reason="PyMeasure is not installed")
    adapters = pytest.importorskip("pymeasure.adapters")
    with served(make_bench(Options(terms=(Level(level_V=LEVEL_V),), noise=False))) as resources:
        adapter = adapters.VISAAdapter(
            resources[link], visa_library="@py", read_termination="\n", write_termination="\n"
        )
        with pytest.warns(FutureWarning, match="SCPI"):  # it says of many instruments that it does not know them
            meter = agilent.Agilent34410A(adapter)
        try:
            assert meter.id == Options().identity
            assert meter.voltage_dc == pytest.approx(LEVEL_V)
        finally:
            adapter.close()
            adapter.manager.close()


@pytest.fixture
def instrumentkit_meter(resource):
    kit = pytest.importorskip("instruments", reason="InstrumentKit is not installed")
    _, host, port, _ = resource.split("::")
    meter = kit.agilent.Agilent34410a.open_tcpip(host, int(port))
    yield meter
    meter._file.close()


def test_instrumentkit_reads_a_voltage(instrumentkit_meter):
    meter = instrumentkit_meter

    assert meter.name == Options().identity
    assert float(meter.measure(meter.Mode.voltage_dc).magnitude) == pytest.approx(LEVEL_V)
    assert float(meter.read_meter().magnitude) == pytest.approx(LEVEL_V)
    assert meter.mode is meter.Mode.voltage_dc


def test_instrumentkit_reads_blocks_and_settings(instrumentkit_meter):
    meter = instrumentkit_meter
    meter.sample_count = 5
    meter.sendcmd("VOLT:NPLC 0.02")
    meter.init()
    while meter.data_point_count < 5:
        pass

    assert meter.sample_count == 5
    assert meter.read_last_data().magnitude == pytest.approx(LEVEL_V)
    assert np.asarray(meter.r(5).magnitude) == pytest.approx([LEVEL_V] * 5)
    assert meter._file.read_raw(1) == b"\n"  # it leaves the end of the line behind
    assert meter.data_point_count == 0


def test_pyvisa_reads_a_block(resource):
    pyvisa = pytest.importorskip("pyvisa")
    manager = pyvisa.ResourceManager("@py")
    meter = manager.open_resource(resource, read_termination="\n", write_termination="\n")
    try:
        meter.write("VOLT:NPLC 0.02;:SAMP:COUN 50;:FORM REAL,64;:INIT;*WAI")
        values_V = meter.query_binary_values("R?", datatype="d", is_big_endian=True, container=np.array)
    finally:
        meter.close()
        manager.close()

    assert values_V == pytest.approx([LEVEL_V] * 50)


def test_a_plain_socket_will_do(resource):
    _, host, port, _ = resource.split("::")
    with socket.create_connection((host, int(port)), timeout=60) as connection, connection.makefile("rw") as file:
        file.write("meas:volt:dc?\n")
        file.flush()
        assert float(file.readline()) == pytest.approx(LEVEL_V)
