"""How the tests of recordings write one."""

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from aemd.block import Batch, Estimates
from aemd.record.description import Description
from aemd.record.writer import Recorder
from tests.record.made import DESCRIPTION


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes batches with their estimates and gives back the finished file."""

    def _record(
        pairs: Iterable[tuple[Batch, Estimates]],
        description: Description = DESCRIPTION,
        name: str = "r.mcap",
        **options: object,
    ) -> Path:
        recorder = Recorder(tmp_path / name, description, **options)  # type: ignore[arg-type]
        for batch, estimates in pairs:
            recorder.write(batch, estimates)
        return recorder.close("end")

    return _record
