"""What the tests of the command line share."""

from collections.abc import Callable

Run = Callable[..., tuple[int, str, str]]


def refused(code: int, err: str, out: str, expected: int) -> str:
    """Assert that this is one clear line with the expected exit code; return the line."""
    lines = err.strip().splitlines()
    assert code == expected, err
    assert len(lines) == 1, err
    assert lines[0].startswith("aemd: ")
    assert out == ""
    return lines[0]
