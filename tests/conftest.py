"""What every test shares: the folder of the real recordings."""

from pathlib import Path

import pytest

SHARED = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings, which is not part of the project."""
    if not SHARED.is_dir():
        pytest.skip(f"the real recordings are not here (looked for {SHARED.name} in ../shared)")
    return SHARED
