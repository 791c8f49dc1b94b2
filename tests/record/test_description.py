import math
import struct

from hypothesis import given
from hypothesis import strategies as st

from aemd.record.description import read_parameters, write_parameters


@given(st.floats())
def test_a_parameter_comes_back_to_the_bit(value: float) -> None:
    _, parameters = read_parameters(write_parameters("aem", {"q": value}))

    back = parameters["q"]
    assert isinstance(back, float)
    assert struct.pack("d", back) == struct.pack("d", value) or (math.isnan(back) and math.isnan(value))


def test_the_types_of_parameters_survive() -> None:
    given_parameters = {"q": 1.0, "window": 1, "adaptive": True, "chooser": 'slope "spread"', "zero": -0.0}

    name, parameters = read_parameters(write_parameters("aem", given_parameters))

    assert name == "aem"
    assert repr(parameters) == repr(given_parameters)
