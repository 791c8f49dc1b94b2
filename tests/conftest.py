"""What all tests share: how hypothesis draws, and where measured logs are found."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("aemd", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("aemd")


@pytest.fixture(scope="session")
def measured(pytestconfig: pytest.Config) -> Path:
    """Folder of measured logs (not part of the project): $AEMD_MEASURED, else shared/measured beside the checkout."""
    stated = os.environ.get("AEMD_MEASURED")
    folder = Path(stated) if stated else pytestconfig.rootpath.parent / "shared" / "measured"
    if not folder.is_dir():
        pytest.skip("no measured logs: set AEMD_MEASURED to their folder")
    return folder
