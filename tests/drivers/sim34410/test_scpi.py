import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim34410.scpi import NO_UNIT, SECONDS, VOLTS, Tree, parse_boolean, parse_choice, parse_message, parse_number
from sim34410.status import ScpiError

TREE = Tree({"[SENSe:]VOLTage[:DC]:NPLCycles": "nplc", "[SENSe:]VOLTage[:DC]:RANGe[:UPPer]": "range", "*RST": "reset"})


def code_of(call, *arguments):
    with pytest.raises(ScpiError) as caught:
        call(*arguments)
    return caught.value.code


def paths(line):
    return [(":".join(unit.path), unit.query, unit.parameters) for unit in parse_message(line)]


@pytest.mark.parametrize(
    "header",
    ["SENS:VOLT:DC:NPLC", "SENSE:VOLTAGE:DC:NPLCYCLES", "VOLT:NPLC", "VOLT:DC:NPLCYCLES", "SENS1:VOLT1:DC:NPLC"],
)
def test_short_and_long_forms_and_optional_nodes_lead_to_the_same_command(header):
    assert TREE.find(tuple(header.split(":"))) == "nplc"


@pytest.mark.parametrize(
    "header", ["SENS:VOLT:DC", "VOLTA:NPLC", "VOL:NPLC", "VOLT:NPLCY", "VOLT2:NPLC", "DC:NPLC", "UPP"]
)
def test_anything_else_is_an_undefined_header(header):
    assert code_of(TREE.find, tuple(header.split(":"))) == -113


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("VOLT:NPLC 1;RANG 10", ["VOLT:NPLC", "VOLT:RANG"]),  # relative to the path of the one before
        ("VOLT:NPLC 1;:TRIG:COUN 1", ["VOLT:NPLC", "TRIG:COUN"]),  # a colon begins at the root
        ("VOLT:NPLC 1;*RST;RANG 10", ["VOLT:NPLC", "*RST", "VOLT:RANG"]),  # a common command leaves the path
        ("volt:nplc 1; ;:Trig:Coun 1;", ["VOLT:NPLC", "TRIG:COUN"]),
        ("ABOR;INIT", ["ABOR", "INIT"]),
        ("", []),
    ],
)
def test_units_of_a_message_follow_the_path_rules(line, expected):
    assert [path for path, _, _ in paths(line)] == expected


def test_separators_within_quotation_marks_are_text():
    assert paths("DISP:TEXT \"a;b,c 'd'\";TEXT? ") == [
        ("DISP:TEXT", False, ("\"a;b,c 'd'\"",)),
        ("DISP:TEXT", True, ()),
    ]


@pytest.mark.parametrize(
    ("line", "code"),
    [("VOLT::NPLC", -102), ("?", -102), ("12", -102), ('DISP:TEXT "a', -151), ("VOLT\x00", -101), ("µ", -101)],
)
def test_what_cannot_be_read_has_its_error_code(line, code):
    assert code_of(paths, line) == code


@pytest.mark.parametrize(
    ("text", "units", "value"),
    [
        ("1e-3", SECONDS, 1e-3),
        ("500 ms", SECONDS, 0.5),
        ("500MS", SECONDS, 0.5),
        ("+20.0us", SECONDS, 20e-6),
        (".5", VOLTS, 0.5),
        ("3.", VOLTS, 3.0),
        ("100 mV", VOLTS, 0.1),
        ("0.1KV", VOLTS, 100.0),
        ("-2E+1", VOLTS, -20.0),
    ],
)
def test_numbers_carry_exponents_and_units(text, units, value):
    assert parse_number(text, units, {}) == value


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("5 V", -131),
        ("abc", -104),
        ("1e", -131),
        ("", -104),
        ("--1", -104),
        ("1e999", -222),
        ("1e99999999999", -104),
        ("1 2", -104),
    ],
)
def test_a_number_that_is_none_has_its_error_code(text, code):
    assert code_of(parse_number, text, SECONDS, {}) == code


def test_named_values_are_taken_in_both_forms():
    named = {"MINimum": 1.0, "INFinity": 2.0}

    assert [parse_number(text, {}, named) for text in ("MIN", "minimum", "inf", "INFINITY")] == [1, 1, 2, 2]
    assert code_of(parse_number, "MINI", NO_UNIT, named) == -104


def test_choices_and_switches():
    assert parse_choice("immediate", ("IMMediate", "BUS")) == "IMM"
    assert code_of(parse_choice, "IMME", ("IMMediate", "BUS")) == -224
    assert [parse_boolean(text) for text in ("on", "OFF", "1", "0", "0.4", "7")] == [
        True,
        False,
        True,
        False,
        False,
        True,
    ]


@given(st.floats(-1e30, 1e30))
def test_every_number_that_python_writes_is_read_back(value):
    assert parse_number(repr(value), VOLTS, {}) == value


@given(st.text(alphabet=st.characters(max_codepoint=255), max_size=80))
def test_no_line_gives_anything_but_units_or_an_scpi_error(line):
    try:
        units = paths(line)
    except ScpiError:
        return

    assert all(path for path, _, _ in units)
